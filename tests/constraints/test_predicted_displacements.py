"""What constraints that forecast do where controls are displacements: rows about braking, and what a search costs."""

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.constraints import rollout as predicted
from safe_wrappers.plants.mujoco.forecast import Recorder

gym.register_envs(pytest.importorskip("gymnasium_robotics"))

pytestmark = pytest.mark.filterwarnings("ignore::safe_wrappers.errors.UnsafeStateWarning")
ZERO = np.zeros(4)


def protected(env_id, steps=1000):
    env = sw.protect(gym.make(env_id, max_episode_steps=steps))
    env.reset(seed=0)
    return env


def to_the_corner(env, way, steps=9):
    for _ in range(steps):
        env.step(np.array(way, np.float32))
    env.filter.observe()


def room(rows, control):
    """What the rows say is left of a control."""
    return float((rows.offsets - rows.normals @ control).min())


def test_rows_and_forecast_agree_about_braking():
    # In the table a displacement of zero comes out, but too slowly.
    env = protected("FetchPush-v4")
    for constraint, slow in zip(env.filter.bound, (False, True), strict=True):
        assert constraint.value().min() < -0.003
        left = float(constraint.slacks(ZERO).min())
        assert (left < 0.0) == slow != constraint.admits(ZERO)
        assert room(constraint.rows(), ZERO) == pytest.approx(left, abs=1e-5)


@pytest.mark.parametrize("way", [[1.0, 0.3, 0.2, 0.0], [-0.8, -1.0, 0.5, 0.0], [0.2, 0.9, 0.4, 0.0]])
def test_rows_foretell_forecasts(way):
    env = protected("FetchReach-v4")
    to_the_corner(env, way)
    box = env.filter.bound[0]
    rows = box.rows()
    rng = np.random.default_rng(0)
    broken = 0
    for _ in range(12):
        control = np.append(rng.uniform(-0.7, 0.7, 3), 0.0)
        left = float(box.slacks(control).min())
        # What no control of the action space could break has no row.
        assert min(room(rows, control), 0.002) == pytest.approx(min(left, 0.002), abs=0.003)
        broken += left < -0.005
    assert broken >= 3


def test_a_cut_goes_through_its_forecast_and_aims_a_little_inward(monkeypatch):
    env = protected("FetchReach-v4")
    to_the_corner(env, [1.0, 1.0, 0.0, 0.0])
    box = env.filter.bound[0]
    box.observe(box.start())  # no response of earlier steps
    box.rows()
    control = np.array([0.5, 0.2, 0.0, 0.0])
    left = float(box.slacks(control).min())
    cut = box.linearize(control)
    assert left < -0.005
    assert room(cut, control) == pytest.approx(1.01 * left, rel=0.01)
    monkeypatch.setattr(predicted, "_RESOLUTION", 0.0)
    box.observe(box.start())
    box.rows()
    exact = box.linearize(control)
    # Rounding a control to single precision moves it by less than 1e-7.
    inward = exact.offsets - cut.offsets
    assert np.allclose(inward, 1e-6 * np.abs(cut.normals).sum(axis=1), rtol=0.02)
    assert (inward > 1e-7 * np.abs(cut.normals).sum(axis=1)).all()


def test_who_is_far_from_a_limit_has_no_rows_and_forecasts_nothing(monkeypatch):
    box = sw.constraints.Workspace([-9.0] * 3, [9.0] * 3, sites=["robot0:grip"], horizon=2, max_decrease=0.1)
    env = sw.CBFActionFilter(gym.make("FetchReach-v4"), [box])
    env.reset(seed=0)
    monkeypatch.setattr(Recorder, "record", None)
    assert not env.filter.bound[0].rows().offsets.size
    env.step(np.ones(4, np.float32))


def counted(monkeypatch):
    calls, whole = [0], Recorder.record

    def record(self, *arguments):
        calls[0] += 1
        return whole(self, *arguments)

    monkeypatch.setattr(Recorder, "record", record)
    return calls


def test_what_a_changed_step_costs(monkeypatch):
    calls, costs = counted(monkeypatch), []
    env = protected("FetchReach-v4")
    rng = np.random.default_rng(1)
    for k in range(60):
        if k % 15 == 0:
            action = np.where(rng.random(4) < 0.5, -1.0, 1.0).astype(np.float32)
        calls[0] = 0
        info = env.step(action)[-1]
        if info["cbf/intervened"]:
            costs.append(calls[0])
        else:
            assert calls[0] <= 1
    # Its own forecast, that of braking and of the answer; differences, of three displacements, every tenth step.
    assert len(costs) > 25 and min(costs) == 3 and np.mean(costs) < 6.0


def test_a_way_out_of_the_table_is_found_whatever_is_asked_for():
    # Pressed into the table a displacement does little; rows about it say that nothing would.
    env = protected("FetchSlide-v4", steps=12)
    rng = np.random.default_rng(1)
    infeasible = 0
    for episode in range(8):
        env.reset(seed=episode)
        action = np.where(rng.random(4) < 0.5, -1.0, 1.0).astype(np.float32)
        action[2] = -1.0
        for _ in range(8):
            infeasible += env.step(action)[-1]["cbf/infeasible"]
    assert infeasible <= 3
