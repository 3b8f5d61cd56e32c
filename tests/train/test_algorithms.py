"""Every algorithm and learner that a config can name: what it is given, killed, continued, and evaluated."""

import gymnasium as gym
import numpy as np
import pytest
from fake_task import HAZARD, FakeFilter
from gymnasium.spaces import Box, Dict, Discrete
from running import episodes, evaluated, finish, killed_after, resumed, trained
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.sb3 import ExecutedActionDictReplayBuffer, ExecutedActionReplayBuffer
from safe_wrappers.train.config.algorithms import ALGORITHMS, DISCRETE, OFF_POLICY, algorithm_class
from safe_wrappers.train.experiment import training_jobs
from safe_wrappers.train.files import read_rows
from safe_wrappers.train.report.page import about
from safe_wrappers.train.run import training as run_module
from safe_wrappers.train.run.checkpoint import latest_checkpoint
from safe_wrappers.train.run.model import check_task, new_model
from safe_wrappers.train.run.stack import make_training_env

SMALL = "policy_kwargs: {net_arch: [8]}"
REPLAY = f"learning_starts: 32, batch_size: 8, train_freq: 8, {SMALL}"
SETTINGS = {
    "PPO": f"n_steps: 32, batch_size: 32, n_epochs: 1, {SMALL}",
    "A2C": f"n_steps: 8, {SMALL}",
    "TRPO": f"n_steps: 32, batch_size: 32, n_critic_updates: 1, {SMALL}",
    "TD3": f"{REPLAY}, action_noise: {{normal: 0.1}}",
    "DDPG": f"{REPLAY}, action_noise: {{ornstein_uhlenbeck: 0.1}}",
} | dict.fromkeys(("SAC", "TQC", "CrossQ", "DQN", "QRDQN"), REPLAY)
SETTINGS |= {f"sbx.{name}": SETTINGS[name] for name in ("PPO", "SAC", "TD3", "TQC", "CrossQ")}
PENALTY = 1000.0
"""An episode of the fake task returns less than 5, so that one penalty in a return would show."""
PENALISED = f"{{kind: adaption_penalty, penalty: {PENALTY}}}"


class BehindTheWall(sw.Constraint):
    """Ends no step right of a wall in the middle of where episodes start."""

    def rows(self):
        return sw.HalfSpaces(np.array([[self.plant.control_dt, 0.0]]), np.array([-self.plant.state[0]]))

    def proposals(self, control):
        """Away from the wall, as fast as the point goes."""
        return [] if control is not None else [np.array([-1.0, 0.0])]


def shield(env):
    """The fake task's point moves by 0.1 of its action: an integrator, held for 0.1 s."""
    plant = sw.AnalyticPlant(
        f=lambda x: np.zeros(2), g=lambda x: np.eye(2), state=lambda env: env.agent_position, control_dt=0.1
    )
    return sw.CBFActionFilter(env, [BehindTheWall()], plant=plant)


def discrete():
    """The fake task with three discrete actions."""
    env = gym.make("fake_task:FakeGoal-v0")
    return gym.wrappers.TransformAction(env, lambda action: np.array([action - 1.0, 0.0]), Discrete(3))


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


def in_parts(shape=(2,)):
    """The fake task's observation in a dict."""
    space = Dict({"at": Box(-np.inf, np.inf, tuple(shape), np.float64)})
    env = gym.make("fake_task:FakeGoal-v0")
    return gym.wrappers.TransformObservation(env, lambda seen: {"at": seen.reshape(shape)}, space)


gym.register("DictGoal-v0", in_parts)


def slow_if_compiled(algorithm):
    """JAX compiles for ten seconds or more; that a model of sbx's goes on as it was is in test_checkpoint."""
    return pytest.param(algorithm, marks=pytest.mark.slow) if algorithm.startswith("sbx.") else algorithm


def one_arm(fake_experiment, algorithm, learner, *overrides):
    """An experiment of one filtered arm."""
    if algorithm not in ("PPO", "A2C", "SAC", "TD3", "DDPG", "DQN"):
        pytest.importorskip("sbx" if algorithm.startswith("sbx.") else "sb3_contrib")
    env, factory = [], "test_algorithms:shield"
    if algorithm in DISCRETE:
        env, factory = ["env=test_algorithms:DiscreteGoal-v0"], "test_algorithms:Shielded"
    elif algorithm == "sbx.SAC":  # which observes a dict of vectors, too
        env = ["env=test_algorithms:DictGoal-v0"]
    return fake_experiment(
        f"algorithm={algorithm}",
        f"hyperparameters={{{SETTINGS[algorithm]}}}",
        f"arms={{a: {{filter: {{factory: '{factory}'}}, learner: {learner}}}}}",
        "total_steps=126",
        "checkpoint_every=64",
        "n_envs=1",
        "normalize={}",
        "evaluation={episodes: 2, seed: 7}",
        *env,
        *overrides,
    )


@pytest.mark.parametrize("wrong", ["policy_kwargs: 3", "train_freq: [4]", "ent_coef: foo"])
def test_what_only_the_algorithm_refuses_is_told_with_the_arm(fake_experiment, wrong):
    (arm,) = one_arm(fake_experiment, "SAC", "naive", f"hyperparameters={{{wrong}}}").arms
    with pytest.raises(ConfigurationError, match=r"arms\.a: SAC refuses its settings: "):
        new_model(arm, 0, DummyVecEnv([lambda: make_training_env(arm)]))


def test_algorithms_that_are_proposed_take_the_actions(fake_experiment):
    (arm,) = one_arm(fake_experiment, "SAC", "naive").arms
    env = make_training_env(arm)
    for space, others in (
        (gym.spaces.Discrete(3), "sbx.PPO, DQN, QRDQN"),
        (gym.spaces.MultiDiscrete([3, 3]), "sbx.PPO"),
    ):
        env.action_space = space
        with pytest.raises(ConfigurationError, match=rf"TRPO, {others}\.$"):
            check_task(arm, env)


@pytest.mark.parametrize("algorithm", [*map(slow_if_compiled, ALGORITHMS)])
def test_trained_killed_continued_and_evaluated(fake_experiment, monkeypatch, algorithm):
    experiment = one_arm(fake_experiment, algorithm, "safe_action" if algorithm in OFF_POLICY else "naive")
    (arm,), (job,) = experiment.arms, training_jobs(one_arm(fake_experiment, algorithm, "naive", "seeds=[0]"))
    folder = killed_after(experiment, 1, arm=0)
    assert latest_checkpoint(folder / "checkpoints").timesteps == 64
    model = resumed(arm, folder)
    assert type(model) is algorithm_class(algorithm)
    if algorithm in OFF_POLICY:
        buffer = model.replay_buffer
        parts = isinstance(model.observation_space, Dict)
        kind = ExecutedActionDictReplayBuffer if parts else ExecutedActionReplayBuffer
        assert type(buffer) is kind and buffer.size() == 64
        assert (np.abs(buffer.rewards[:64]) < 1).all()
    trained(experiment, 0)
    # As many steps as were announced, and are reported: whole rollouts.
    assert finish(folder)["timesteps"] == job.total == 128
    assert ", 126 to 128 steps, " in about(experiment)  # the second seed is still to come
    rows = episodes(folder)
    assert len(rows) == 64 // 20 + 64 // 20 and sum(row["intervention_rate"] for row in rows) > 0
    out = evaluated(experiment, 0)
    assert all(len(read_rows(out / f"filter_{state}.csv")) == 2 for state in ("off", "on"))


def test_a_rollout_may_be_whole_episodes(fake_experiment):
    freely = "hyperparameters={learning_starts: 1000, train_freq: [1, episode]}"
    experiment = fake_experiment(
        "algorithm=SAC", freely, "arms={a: {filter: none}}", "total_steps=30", "n_envs=1"
    )
    assert finish(trained(experiment, 0))["timesteps"] == 40


class Watch(BaseCallback):
    """What the algorithm was paid, beside the task's own reward."""

    def __init__(self):
        super().__init__()
        self.paid, self.infos = [], []

    def _on_step(self):
        self.paid.append(self.locals["rewards"].copy())
        self.infos.append(self.locals["infos"])
        return True


@pytest.mark.parametrize(
    ("algorithm", "learner"),
    [("SAC", "naive"), ("SAC", "safe_action"), ("SAC", PENALISED), ("PPO", PENALISED)],
)
def test_training_has_what_the_kind_says_and_what_is_reported_is_the_tasks(
    fake_experiment, monkeypatch, algorithm, learner
):
    experiment = one_arm(fake_experiment, algorithm, learner, "n_envs=2", "total_steps=192")
    (arm,), watch = experiment.arms, Watch()
    monkeypatch.setattr(run_module, "InterventionCallback", lambda: watch)
    folder = trained(experiment, 0)
    model, infos = watch.model, np.array(watch.infos)  # (steps, envs)
    changed = np.array([[info[keys.CBF_INTERVENED] for info in row] for row in infos])
    assert 0.02 < changed.mean() < 0.98
    if arm.learner.penalised:
        taken = np.array([[info[keys.ADAPTION_PENALTY] for info in row] for row in infos])
        assert (taken == changed * PENALTY).all()
        assert np.abs(np.array(watch.paid) + taken).max() < 1.0
    else:
        assert keys.ADAPTION_PENALTY not in infos[0, 0] and np.abs(watch.paid).max() < 1.0
    rows = episodes(folder)
    assert len(rows) == 2 * (96 // 20) and all(abs(row["return"]) < 5 for row in rows)
    # What SB3 logs as rollout/ep_rew_mean is the same.
    ends = [info["episode"]["r"] for info in infos.ravel() if "episode" in info]
    assert sorted(ends) == pytest.approx(sorted(row["return"] for row in rows), abs=1e-5)
    if algorithm == "SAC":
        buffer = model.replay_buffer
        assert type(buffer) is (ExecutedActionReplayBuffer if arm.learner.stores_executed else ReplayBuffer)
        executed = np.array([[info[keys.EXECUTED_ACTION] for info in row] for row in infos], np.float32)
        difference = np.abs(buffer.actions[: len(infos)] - executed).max(axis=-1)
        assert (difference > 1e-6).any() == (not arm.learner.stores_executed)
    if arm.learner.penalised:  # an evaluation never has the penalty
        evaluated_rows = read_rows(evaluated(experiment, 0) / "filter_on.csv")
        assert sum(row["intervention_rate"] for row in evaluated_rows) > 0
        assert all(abs(row["return"]) < 5 for row in evaluated_rows)
