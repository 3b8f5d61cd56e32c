"""`env.observation` and `action_repeat` of a config: the same in training and in evaluation, filter on and off."""

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.plants.env_checks import wrappers_of
from safe_wrappers.train.config import EvaluationConfig, FilterConfig, parse_experiment
from safe_wrappers.train.evaluation.evaluate import evaluate_run, evaluated_steps, evaluation_folder
from safe_wrappers.train.files import read_rows
from safe_wrappers.train.report.page import about
from safe_wrappers.train.run import Progress, train_run
from safe_wrappers.train.run.policy import TrainedPolicy
from safe_wrappers.train.run.stack import make_stack, make_vec_env
from safe_wrappers.train.run.training import finished_checkpoint

SILENT = Progress(lambda steps: None, pytest.fail)
PROTECTED = FilterConfig(protect={})
SETTINGS = {
    "name": "seen",
    "env": {"id": "SafePointGoal1-v0", "observation": "constraints", "kwargs": {"max_episode_steps": 50}},
    "algorithm": "PPO",
    "hyperparameters": {"n_steps": 16, "batch_size": 16, "n_epochs": 1},
    "total_steps": 16,
    "action_repeat": 4,
    "arms": {"unfiltered": {"filter": "none"}, "filtered": {"filter": "protect"}},
    "seeds": [0],
}


def arms(tmp_path, **more):
    experiment = parse_experiment({**SETTINGS, "output": str(tmp_path), **more})
    return experiment, {arm.name: arm for arm in experiment.arms}


def test_all_arms_observe_the_same_features(tmp_path):
    _, by_name = arms(tmp_path)
    seen = {name: make_stack(arm.env, arm.filter).reset(seed=3)[0] for name, arm in by_name.items()}
    taken_off = make_stack(by_name["filtered"].env, FilterConfig()).reset(seed=3)[0]
    alone = sw.FilterObservation(sw.protect(gym.make("SafePointGoal1-v0"))).reset(seed=3)[0]
    for observation in (*seen.values(), taken_off):
        np.testing.assert_array_equal(observation, alone)


def test_a_policy_acts_in_evaluation_as_it_was_trained(tmp_path):
    """Beside SB3's own `predict` in a loop over ActionRepeat."""
    experiment, by_name = arms(tmp_path)
    arm = by_name["filtered"]
    folder = experiment.run_folder(arm, 0)
    train_run(arm, 0, folder, SILENT)
    evaluate_run(arm, 0, folder, EvaluationConfig(episodes=2, seed=7), PROTECTED, SILENT)
    rows = read_rows(evaluation_folder(folder) / "filter_on.csv")
    model = finished_checkpoint(arm, 0, folder).load_model("PPO", None, "cpu")
    env = sw.RecordInterventions(
        sw.FilterObservation(sw.protect(gym.make("SafePointGoal1-v0", max_episode_steps=50)))
    )
    env = sw.ActionRepeat(env, 4)
    for seed, row in zip((7, 8), rows, strict=True):
        observation, _ = env.reset(seed=seed)
        truncated = False
        while not truncated:
            observation, _, _, truncated, info = env.step(model.predict(observation, deterministic=True)[0])
        assert float(row["return"]) == pytest.approx(info["interventions"]["return"], abs=1e-12)
        assert float(row["length"]) == 50
    log = evaluated_steps(folder, "filter_on")
    assert len(log) == 100  # control steps
    held = log.proposed[:48].reshape(12, 4, 2)
    assert (held == held[:, :1]).all()


def test_training_steps_are_the_policys(tmp_path):
    _, by_name = arms(tmp_path)
    envs = make_vec_env(by_name["filtered"])
    envs.seed(0)
    envs.reset()
    for _ in range(13):
        _, _, done, infos = envs.step(np.zeros((1, 2), dtype=np.float32))
    assert done[0]
    assert infos[0]["interventions"]["length"] == 50
    envs.close()


def test_the_report_counts_control_steps(tmp_path):
    assert ", 64 steps, " in about(arms(tmp_path)[0])
    assert ", 16 steps, " in about(arms(tmp_path, action_repeat=1)[0])


def test_a_run_without_a_repeat_is_known_by_its_old_folder(tmp_path):
    _, once = arms(tmp_path, action_repeat=1)
    _, four = arms(tmp_path)
    assert "action_repeat" not in once["filtered"].fingerprint()
    assert four["filtered"].fingerprint()["action_repeat"] == 4


def test_a_trained_policy_is_deterministic_unless_told(tmp_path):
    experiment, by_name = arms(tmp_path, action_repeat=1)
    arm = by_name["unfiltered"]
    folder = experiment.run_folder(arm, 0)
    train_run(arm, 0, folder, SILENT)
    policy = TrainedPolicy(arm, finished_checkpoint(arm, 0, folder))
    observation, _ = make_stack(arm.env, arm.filter).reset(seed=0)
    np.testing.assert_array_equal(policy(observation), policy(observation))
    policy.deterministic = False
    assert not np.array_equal(policy(observation), policy(observation))


def test_observing_needs_a_filter_with_constraints(tmp_path):
    with pytest.raises(sw.SafeWrappersError, match=r"env\.observation: there is no filter whose constraints"):
        arms(tmp_path, arms={"unfiltered": {"filter": "none"}})


def test_an_escape_is_around_the_filter_in_training_and_evaluation(tmp_path):
    escaping = {"filter": {"protect": {}, "escape": {"progress": 0.1, "escape_s": 0.5}}}
    _, by_name = arms(tmp_path, arms={"unfiltered": {"filter": "none"}, "filtered": escaping})
    env = make_stack(by_name["filtered"].env, by_name["filtered"].filter)
    escape = next(w for w in wrappers_of(env) if isinstance(w, sw.StuckEscape))
    assert escape.progress == 0.1
    info = env.reset(seed=0)[1]
    assert info["cbf/stuck"] is False
    assert by_name["filtered"].fingerprint()["filter"]["escape"] == {"progress": 0.1, "escape_s": 0.5}
    assert by_name["unfiltered"].env.observation.escape is None  # observed, not acted on


def test_an_escape_needs_a_filter(tmp_path):
    with pytest.raises(sw.SafeWrappersError, match="escape"):
        arms(tmp_path, arms={"filtered": {"filter": {"escape": {}}}})
