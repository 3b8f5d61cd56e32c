import gymnasium as gym
import numpy as np
import pytest
from made_up import steps

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.train.evaluation import step_log
from safe_wrappers.train.evaluation.step_log import StepRecorder, load_steps, pool, save_steps


def record(env, actions, seed=0):
    """Runs the actions; returns the log and the infos."""
    recorder, infos = StepRecorder(env), []
    observation, _ = env.reset(seed=seed)
    recorder.begin(seed)
    for action in actions:
        recorder.before(observation)
        observation, _, _, _, info = env.step(action)
        recorder.after(action, info)
        infos.append(info)
    return recorder.finish(), infos


def test_the_filters_word_is_taken_down_step_by_step(tmp_path):
    limits = [sw.constraints.JointSpeedLimit(limit=4.0), sw.constraints.JointSpeedLimit(limit=2.0)]
    env = sw.CBFActionFilter(gym.make("Reacher-v5"), limits)
    actions = np.random.default_rng(0).uniform(-1, 1, (40, 2)).astype(np.float32)
    log, infos = record(sw.RecordInterventions(env), actions)
    save_steps(tmp_path / "steps.npz", log)
    log = load_steps(tmp_path / "steps.npz")
    assert list(log.constraint_names) == env.constraint_names
    assert log.refused.shape == (40, 2)
    for name, key in (
        ("intervened", keys.CBF_INTERVENED),
        ("refused", keys.CBF_REFUSED),
        ("proposed", keys.PROPOSED_ACTION),
        ("correction", keys.CBF_CORRECTION),
    ):
        assert getattr(log, name) == pytest.approx(np.array([info[key] for info in infos])), name
    # The tighter limit refuses whatever the wider one refuses, and more.
    assert log.refused[:, 1].sum() > log.refused[:, 0].sum()
    assert (log.refused.any(axis=1) == log.intervened).all()
    assert log.step.tolist() == list(range(40))
    assert log.coordinates.dtype == np.float32
    # The state in which the step began, not the one after it.
    assert log.coordinates[0, 4:6] == pytest.approx(env.unwrapped.init_qvel[:2], abs=0.01)
    assert (tmp_path / "steps.npz").stat().st_size < 20_000


def test_without_a_filter_nothing_was_done():
    actions = np.full((5, 2), 0.5, np.float32)
    log, _ = record(gym.make("SafePointGoal1-v0"), actions)
    assert not (log.intervened.any() or log.violated.any())
    assert (log.proposed == 0.5).all()
    assert log.refused.shape == (5, 0)
    assert len(log.constraint_names) == 0


def test_what_is_beyond_the_cap_is_counted(monkeypatch):
    monkeypatch.setattr(step_log, "MOST_STEPS", 3)
    log, _ = record(gym.make("Pendulum-v1"), np.zeros((5, 1), np.float32))
    assert (len(log), log.left_out) == (3, 2)


def test_a_filter_that_names_nothing_has_numbered_constraints():
    class Refusing(gym.Wrapper):
        def step(self, action):
            *rest, info = self.env.step(action)
            return *rest, info | {keys.CBF_REFUSED: np.array([True, False])}

    log, _ = record(Refusing(gym.make("Pendulum-v1")), np.zeros((2, 1), np.float32))
    assert list(log.constraint_names) == ["constraint 1", "constraint 2"]


def test_seeds_are_pooled_and_different_tasks_are_not():
    one, two = steps(10), steps(20, left_out=5)
    both = pool([one, two])
    assert (len(both), both.left_out) == (30, 5)
    assert both.coordinates[10:] == pytest.approx(two.coordinates)
    assert pool([]) is None
    assert pool([one, steps(10, coordinate_names=np.array(["a", "b", "c"]))]) is None
    assert pool([one, steps(10, constraint_names=np.array(["Other"]))]) is None
