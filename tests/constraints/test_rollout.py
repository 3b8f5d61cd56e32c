"""What constraints on a forecast share: what is asked of it, when it is spared, and when it breaks down."""

import warnings

import numpy as np
import pytest
from asking import asked
from hypothesis import assume, given
from hypothesis import strategies as st
from judged_loops import slider

import safe_wrappers as sw

HOLD_S = 0.05


def slider_path(x, v, u, horizon, strength):
    """The slider after every substep: the control held, then braking at half of its speed per control step.

    The speed that is read for it is MuJoCo's `actuator_velocity`, which is one Euler step old.
    """
    path, before = [], v
    for hold in range(horizon):
        if hold:
            u = float(np.clip(-0.5 * before / HOLD_S, -strength, strength))
        for _ in range(5):
            before = v
            v += 0.01 * u
            x += 0.01 * v
            path.append(x)
    return np.array(path)


# What is asked ------------------------------------------------------------------------------------------------


@given(
    x=st.floats(-1.6, 1.6),
    v=st.floats(-4.0, 4.0),
    u=st.floats(-30.0, 30.0),
    horizon=st.integers(1, 6),
    margin=st.sampled_from([0.0, 0.2]),
)
def test_a_control_is_admitted_by_where_it_leads(x, v, u, horizon, margin):
    scene = slider(30.0)
    scene.data.qpos[:], scene.data.qvel[:] = x, v
    limit = asked(scene, sw.constraints.JointPositionLimit(-1.0, 1.0, horizon=horizon, margin=margin))
    beyond = np.abs(slider_path(x, v, u, horizon, 30.0)) - (1.0 - margin)
    start = abs(x) - (1.0 - margin)
    if start <= 0.0:
        missing = beyond.max()
    else:  # no farther out than it is, and back to exp(-t / 0.1 s) of it at the end, on the side that it is out on
        side = np.sign(x) * slider_path(x, v, u, horizon, 30.0) - (1.0 - margin)
        other = -side - 2.0 * (1.0 - margin)
        missing = max(side.max() - start, side[-1] - start * np.exp(-horizon * HOLD_S / 0.1), other.max())
    assume(abs(missing) > 1e-7 and abs(start) > 1e-9)
    assert limit.admits(np.array([u])) == (missing < 0.0)
    assert limit.slack(np.array([u])) == pytest.approx(-missing, abs=1e-9)
    assert limit.value().min() == pytest.approx(1.0 - abs(x), abs=1e-12)


# Forecasts that are spared ------------------------------------------------------------------------------------


def test_a_reach_spares_forecasts_and_changes_nothing_else(monkeypatch):
    calls, rollout = [0], sw.MujocoPlant.rollout

    def counted(self, control, *asked):
        calls[0] += control is not None
        return rollout(self, control, *asked)

    monkeypatch.setattr(sw.MujocoPlant, "rollout", counted)
    actions = np.repeat(np.random.default_rng(0).choice([-1.0, 1.0], (40, 1)), 12, axis=0)

    def driven(max_decrease):
        limit = sw.constraints.JointPositionLimit(-1.0, 1.0, horizon=4, max_decrease=max_decrease)
        filtered = sw.CBFActionFilter(slider(10.0), [limit])
        filtered.reset(seed=0)
        calls[0] = 0
        with warnings.catch_warnings(action="error"):
            infos = [filtered.step(action)[4] for action in actions]
        assert sum(info["cbf/intervened"] for info in infos) > 20
        return np.array([info["executed_action"] for info in infos]), calls[0]

    (free, often), (bounded, seldom) = map(driven, (None, 0.5))  # at most 2 m/s, four control steps are 0.2 s
    np.testing.assert_array_equal(free, bounded)
    assert seldom < often - 50


# Machines that cannot be forecast --------------------------------------------------


def test_a_model_that_breaks_down_in_the_forecast_is_not_admitted(tmp_path, monkeypatch):
    # MuJoCo resets it, and from the reset on all looks well.
    monkeypatch.chdir(tmp_path)  # it writes a log
    limit = asked(slider(1e9, gear=1000.0), sw.constraints.JointPositionLimit(-1e6, 1e6))
    assert limit.admits(np.array([1.0]))
    assert not limit.admits(np.array([1e9]))
    assert limit.admits(np.array([2.0]))  # and the next one is a forecast again
