"""What a config puts around the task and beside the learning: each layer in its place, in training and evaluation."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback
from test_run import Reports

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, UnknownNameError
from safe_wrappers.plants.env_checks import wrappers_of
from safe_wrappers.train.config import EnvConfig, EvaluationConfig, FilterConfig, parse_experiment
from safe_wrappers.train.evaluation.evaluate import evaluate_run, evaluated_steps, evaluation_folder
from safe_wrappers.train.files import read_rows
from safe_wrappers.train.run import train_run, training
from safe_wrappers.train.run.policy import TrainedPolicy
from safe_wrappers.train.run.stack import make_stack, make_vec_env
from safe_wrappers.train.run.training import finished_checkpoint

QUIET = Reports().progress
OUTAGES = {"mean_between_s": 0.2, "mean_length_s": 0.2}
LEASE = {"budget": {"closing_speed": 3.0}, "min_lease_s": 0.02}


def parsed(env="SafePointGoal1-v0", output="runs", **arms):
    common = {"name": "x", "algorithm": "PPO", "total_steps": 10, "seeds": [0], "output": str(output)}
    return parse_experiment({**common, "env": env, "arms": arms})


@pytest.mark.parametrize(
    ("env", "filter_", "error", "words"),
    [
        ("Reacher-v5", {"lease": LEASE}, ConfigurationError, "beside it"),
        ("Reacher-v5", {"escape": {}}, ConfigurationError, "escape"),
        ({"id": "Reacher-v5", "observation": "constraints"}, "none", ConfigurationError, "no filter whose"),
    ],
)
def test_what_cannot_be_is_refused_by_name(env, filter_, error, words):
    with pytest.raises(error, match=words):
        parsed(env=env, a={"filter": filter_})


def test_arguments_that_are_missing_or_wrong_are_named():
    with pytest.raises(UnknownNameError, match=r"env.faults: unknown name 'Outage'. Did you mean 'Outages'"):
        make_stack(EnvConfig("Reacher-v5", {}, {"Outage": {}}), FilterConfig())
    with pytest.raises(ConfigurationError, match=r"env.faults.Outages.*mean_between_s"):
        make_stack(EnvConfig("Reacher-v5", {}, {"Outages": {}}), FilterConfig())
    with pytest.raises(ConfigurationError, match=r"env.occlusion.*tracks"):
        make_stack(EnvConfig("OccludedCrossing-v0", {}, {}, {}), FilterConfig())
    with pytest.raises(ConfigurationError, match="closing"):
        lease = {"budget": {"closing": 1.0}}
        make_stack(EnvConfig("SafePointGoal1-v0"), FilterConfig(protect={}, lease=lease))
    with pytest.raises(ConfigurationError, match="2 constraints; say which one"):
        make_stack(EnvConfig("Pusher-v5"), FilterConfig(protect={}, lease=LEASE))


def test_the_stack_has_every_layer_in_its_place():
    faults = {"Outages": OUTAGES, "RepeatedCommands": {"share": 0.1}}
    filtered = FilterConfig(protect={}, lease=LEASE, escape={"progress": 0.1})
    stack = make_stack(EnvConfig("SafePointGoal1-v0", {}, faults), filtered)
    kinds = [type(wrapper).__name__ for wrapper in wrappers_of(stack)]
    order = [
        "RepeatedCommands",
        "Outages",
        "RecordInterventions",
        "StuckEscape",
        "LeaseExpiry",
        "CBFActionFilter",
    ]
    assert [kind for kind in kinds if kind in order] == order
    stack.reset(seed=0)
    infos = [stack.step(np.array([0.3, 0.1], np.float32))[4] for _ in range(100)]
    assert any(i["fault/active"] for i in infos) and any(i["lease/remaining_s"] > 0.02 for i in infos)
    assert not any(i["cost"] for i in infos)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning")
def test_the_occlusion_penalty_is_inside_the_filter_and_the_recorder_counts_what_it_tells():
    occlusion = {
        "tracks": [{"bodies": "car*", "acceleration_noise": [0.0225, 0], "start_position_std": [0.3, 0]}],
        "sensor": {"camera": "eye", "range_m": 6},
        "tolerance": 0.5,
        "weight": 0.1,
    }
    env = EnvConfig("OccludedCrossing-v0", {}, {}, occlusion)
    stack = make_stack(env, FilterConfig(protect={"cars": "estimated"}))
    stack.reset(seed=0)
    total, taken, info, done = 0.0, 0.0, {}, False
    while not done:
        _, reward, _, done, info = stack.step(np.array([0.0, 1.0, 0.2], np.float32))
        total, taken = total + reward, taken + info["occlusion/penalty"]
    assert info["interventions"]["return"] == pytest.approx(total + taken)
    assert info["episode"]["r"] == pytest.approx(total, abs=1e-5)  # Monitor's holds the penalty
    assert info["interventions"]["return"] > total and "collisions" in info["interventions"]


# Observations and held actions ------------------------------------------------------------------------------------

SEEN = {
    "name": "seen",
    "env": {"id": "SafePointGoal1-v0", "observation": "constraints", "kwargs": {"max_episode_steps": 50}},
    "algorithm": "PPO",
    "hyperparameters": {"n_steps": 16, "batch_size": 16, "n_epochs": 1},
    "total_steps": 16,
    "action_repeat": 4,
    "arms": {"unfiltered": {"filter": "none"}, "filtered": {"filter": "protect"}},
    "seeds": [0],
}


def test_all_arms_observe_the_same_features():
    arms = parse_experiment(SEEN).arms
    seen = [
        make_stack(arm.env, used).reset(seed=3)[0] for arm in arms for used in (arm.filter, FilterConfig())
    ]
    alone = sw.FilterObservation(sw.protect(gym.make("SafePointGoal1-v0"))).reset(seed=3)[0]
    for observation in seen:
        np.testing.assert_array_equal(observation, alone)


def test_a_policy_acts_in_evaluation_as_it_was_trained(tmp_path):
    """Beside SB3's own `predict` in a loop over ActionRepeat."""
    arm = parse_experiment(SEEN).arms[1]
    envs = make_vec_env(arm)
    envs.reset()
    dones = [envs.step(np.zeros((1, 2), dtype=np.float32))[2][0] for _ in range(13)]
    assert dones[-1] and not any(dones[:-1])  # its steps are the policy's
    train_run(arm, 0, tmp_path, QUIET)
    evaluate_run(arm, 0, tmp_path, EvaluationConfig(episodes=2, seed=7), arm.filter, QUIET)
    rows = read_rows(evaluation_folder(tmp_path) / "filter_on.csv")
    policy = TrainedPolicy(arm, finished_checkpoint(arm, 0, tmp_path).folder)
    env = sw.FilterObservation(sw.protect(gym.make("SafePointGoal1-v0", max_episode_steps=50)))
    env = sw.ActionRepeat(sw.RecordInterventions(env), 4)
    for seed, row in zip((7, 8), rows, strict=True):
        observation, _ = env.reset(seed=seed)
        truncated = False
        while not truncated:
            action = policy.model.predict(observation, deterministic=True)[0]
            observation, _, _, truncated, info = env.step(action)
        assert float(row["return"]) == pytest.approx(info["interventions"]["return"], abs=1e-12)
        assert float(row["length"]) == 50
    held = evaluated_steps(tmp_path, "filter_on").proposed[:48].reshape(12, 4, 2)
    assert (held == held[:, :1]).all()
    policy.deterministic = False
    policy.reset()
    first = policy(observation)
    policy.reset()
    assert not np.array_equal(policy(observation), first)


# A price that changes in training -----------------------------------------------------------------------

LIMIT = "arms.unfiltered.learner={cost_limit: 0, multiplier_rate: 0.01}"


@pytest.fixture
def seen(monkeypatch):
    """By the run's steps: the price on cost."""
    found = {}

    class Watch(BaseCallback):
        def _on_step(self):
            found[self.num_timesteps] = getattr(self.model, "lagrangian_multiplier", 0.0)
            return True

    made = training.learner_callbacks
    monkeypatch.setattr(training, "learner_callbacks", lambda arm: [*made(arm), Watch()])
    return found


def run(experiment):
    arm = experiment.arms[0]
    train_run(arm, 0, experiment.run_folder(arm, 0), QUIET)
    return arm, experiment.run_folder(arm, 0)


def test_the_price_on_cost_rises_where_there_is_a_limit_and_goes_on_from_a_checkpoint(fake_experiment, seen):
    run(fake_experiment(LIMIT))
    stood = seen[max(seen)]
    assert stood > 0.0
    seen.clear()
    run(fake_experiment(LIMIT, "total_steps=1024"))
    assert seen[min(seen)] == stood
    seen.clear()
    run(fake_experiment("name=without"))
    assert set(seen.values()) == {0.0}


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("arms.unfiltered.learner={cost_limit: -1}", "cost_limit"),
        ("arms.unfiltered={algorithm: SAC, learner: {cost_limit: 1}}", "leave normalize out"),
    ],
)
def test_what_would_change_nothing_is_refused(fake_experiment, given, words):
    with pytest.raises(ConfigurationError, match=words):
        fake_experiment(given)
