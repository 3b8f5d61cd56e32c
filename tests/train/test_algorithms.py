"""Every algorithm that a config can name: trained through the filter, killed, continued, evaluated."""

import json

import gymnasium as gym
import numpy as np
import pytest
from fake_task import HAZARD, FakeFilter
from gymnasium.spaces import Discrete
from test_run import Reports, run_killed_after

from safe_wrappers import info as keys
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.sb3 import ExecutedActionReplayBuffer
from safe_wrappers.train.config import EvaluationConfig
from safe_wrappers.train.config.algorithms import ALGORITHMS, DISCRETE, OFF_POLICY, algorithm_class
from safe_wrappers.train.evaluation.evaluate import evaluate_run, evaluation_folder
from safe_wrappers.train.experiment import training_jobs
from safe_wrappers.train.files import read_rows
from safe_wrappers.train.report.page import about
from safe_wrappers.train.run.checkpoint import latest_checkpoint, resume
from safe_wrappers.train.run.model import _constructor_arguments as constructor_arguments
from safe_wrappers.train.run.model import check_task
from safe_wrappers.train.run.stack import make_stack, make_vec_env
from safe_wrappers.train.run.training import train_run

SMALL = "policy_kwargs: {net_arch: [8]}"
REPLAY = f"learning_starts: 32, batch_size: 8, train_freq: 8, {SMALL}"
SETTINGS = {
    "PPO": f"n_steps: 32, batch_size: 32, n_epochs: 1, {SMALL}",
    "A2C": f"n_steps: 8, {SMALL}",
    "TRPO": f"n_steps: 32, batch_size: 32, n_critic_updates: 1, {SMALL}",
    "TD3": f"{REPLAY}, action_noise: {{normal: 0.1}}",
    "DDPG": f"{REPLAY}, action_noise: {{ornstein_uhlenbeck: 0.1}}",
} | dict.fromkeys(("SAC", "TQC", "CrossQ", "DQN", "QRDQN"), REPLAY)
FILTERED = "filter: {factory: 'test_learner:shield'}"


class Left(gym.Wrapper):
    """The fake task with three discrete actions."""

    def __init__(self, env):
        super().__init__(env)
        self.action_space = Discrete(3)

    def step(self, action):
        assert isinstance(action, int | np.integer) or np.ndim(action) == 0
        return self.env.step(np.array([float(action) - 1.0, 0.0]))


def discrete():
    return Left(gym.make("fake_task:FakeGoal-v0"))


gym.register("DiscreteGoal-v0", discrete)


class Shielded(FakeFilter):
    """The fake filter for those three actions."""

    def step(self, action):
        at = self.unwrapped.agent_position + 0.1 * np.array([float(action) - 1.0, 0.0])
        refused = np.linalg.norm(at - HAZARD) - self.unwrapped.hazard_radius < self.margin
        *result, info = self.env.step(1 if refused else action)
        info.update(dict.fromkeys(keys.CBF_BOOLS, False) | dict.fromkeys(keys.CBF_FLOATS, 0.0))
        info[keys.CBF_INTERVENED] = refused
        return *result, info


def shielded(env):
    return Shielded(env)


def one_arm(fake_experiment, algorithm, arm, *overrides):
    discrete = ["env=test_algorithms:DiscreteGoal-v0"] if algorithm in DISCRETE else []
    return fake_experiment(
        f"algorithm={algorithm}",
        f"hyperparameters={{{SETTINGS[algorithm]}}}",
        f"arms={{a: {{{arm}}}}}",
        "total_steps=192",
        "checkpoint_every=64",
        "n_envs=1",
        "normalize={}",
        *discrete,
        *overrides,
    )


def installed(algorithm):
    if algorithm not in ("PPO", "A2C", "SAC", "TD3", "DDPG", "DQN"):
        pytest.importorskip("sb3_contrib")
    return algorithm


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_trained_killed_continued_and_evaluated(fake_experiment, monkeypatch, algorithm):
    installed(algorithm)
    discrete = algorithm in DISCRETE
    arm = FILTERED if not discrete else "filter: {factory: 'test_algorithms:shielded'}"
    arm += ", learner: safe_action" if algorithm in OFF_POLICY else ""
    experiment = one_arm(fake_experiment, algorithm, arm)
    (arm,) = experiment.arms
    folder = run_killed_after(experiment, 1, monkeypatch, arm=0)
    checkpoint = latest_checkpoint(folder / "checkpoints")
    assert checkpoint.timesteps == 64
    model = resume(checkpoint.folder, algorithm, make_vec_env(arm), "cpu", 192)
    assert type(model) is algorithm_class(algorithm)
    if algorithm in OFF_POLICY:
        assert type(model.replay_buffer) is ExecutedActionReplayBuffer
        assert model.replay_buffer.size() == 64
    train_run(arm, 0, folder, Reports().progress)
    assert json.loads((folder / "finished.json").read_text())["timesteps"] == 192
    rows = read_rows(folder / "episodes.csv")
    assert len(rows) == 64 // 20 + 128 // 20
    assert sum(row["intervention_rate"] for row in rows) > 0
    evaluate_run(arm, 0, folder, EvaluationConfig(2, 7), experiment.evaluation_filter, Reports().progress)
    for condition in ("filter_off", "filter_on"):
        assert len(read_rows(evaluation_folder(folder) / f"{condition}.csv")) == 2


@pytest.mark.parametrize(
    ("algorithm", "env", "message"),
    [
        (
            "SAC",
            "test_algorithms:DiscreteGoal-v0",
            r"SAC needs actions of a Box, and .*Discrete\(3\).*PPO",
        ),
        ("DQN", "fake_task:FakeGoal-v0", r"DQN needs actions of a Discrete, and fake_task.*PPO"),
    ],
)
def test_actions_of_the_wrong_kind_are_refused_before_the_first_step(
    fake_experiment, algorithm, env, message
):
    (arm,) = one_arm(fake_experiment, algorithm, "filter: none", f"env={env}").arms
    with pytest.raises(ConfigurationError, match=f"arms.a: {message}"):
        check_task(arm, make_stack(arm.env, arm.filter))


# Action noise --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm", ["TD3", "DDPG"])
def test_a_deterministic_policy_needs_a_word_on_noise(fake_experiment, algorithm):
    with pytest.raises(ConfigurationError, match=f"policy of {algorithm} is deterministic") as refusal:
        fake_experiment("hyperparameters={}", f"algorithm={algorithm}", "arms={a: {filter: none}}")
    for offered, kind in (
        ("{normal: 0.1}", "Normal"),
        ("{ornstein_uhlenbeck: 0.1}", "Ornstein"),
        ("none", "None"),
    ):
        assert offered in str(refusal.value) or offered == "none"
        noise = f"hyperparameters={{action_noise: {offered}}}"
        (arm,) = fake_experiment(noise, f"algorithm={algorithm}", "arms={a: {filter: none}}").arms
        made = constructor_arguments(arm, make_vec_env(arm))["action_noise"]
        assert type(made).__name__.startswith(kind)


@pytest.mark.parametrize(
    ("algorithm", "hyperparameters", "steps"),
    [
        ("PPO", "{n_steps: 64, batch_size: 64, n_epochs: 1}", 256),
        ("A2C", "{}", 140),
        ("SAC", "{learning_starts: 1000, train_freq: 8}", 144),
        ("SAC", "{learning_starts: 1000, train_freq: [1, episode]}", None),
    ],
)
def test_the_steps_that_are_announced_and_reported_are_those_that_are_trained(
    fake_experiment, algorithm, hyperparameters, steps
):
    experiment = fake_experiment(
        "total_steps=134",
        f"algorithm={algorithm}",
        f"hyperparameters={hyperparameters}",
        "arms={one: {filter: none}}",
        "seeds=[0]",
        *(["n_envs=1"] if "episode" in hyperparameters else []),
    )
    (arm,), folder = experiment.arms, experiment.run_folder(experiment.arms[0], 0)
    (job,) = training_jobs(experiment)
    train_run(arm, 0, folder, Reports().progress)
    trained = json.loads((folder / "finished.json").read_text())["timesteps"]
    assert f", {trained:,} steps, " in about(experiment)
    if steps is not None:  # of whole episodes nobody knows the steps beforehand
        assert trained == steps == job.total
