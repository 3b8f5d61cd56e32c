"""What constraints on a forecast share: what is asked of it, from inside and from outside, and when it is spared."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from asking import Asked, bound
from hypothesis import assume, given
from hypothesis import strategies as st
from judged_loops import Judge, flagged, sliders

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError

HOLD_S = 0.05
LIMITS = {
    "speed": lambda **more: sw.constraints.SpeedLimit(0.8, "b0", "x", "substep", **more),
    "joint position": lambda **more: sw.constraints.JointPositionLimit(-1.0, 1.0, **more),
    "joint speed": lambda **more: sw.constraints.JointSpeedLimit(0.8, **more),
    "workspace": lambda **more: sw.constraints.Workspace(
        [-1.0, None, None], [1.0, None, None], bodies=["b0"], **more
    ),
    "upright": lambda **more: sw.constraints.Upright("b0", lowest=-1.0, **more),
}
kinds = pytest.mark.parametrize("kind", LIMITS)


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


def looking(scene, limit, qpos, qvel):
    """The limit, bound to a plant that has seen this state."""
    plant = bound(scene)
    scene.data.qpos[:], scene.data.qvel[:] = qpos, qvel
    plant.observe()
    return Asked(limit, plant)


# What is asked ------------------------------------------------------------------------------------------------


@given(
    x=st.floats(-1.6, 1.6),
    v=st.floats(-4.0, 4.0),
    u=st.floats(-30.0, 30.0),
    horizon=st.integers(1, 6),
    margin=st.sampled_from([0.0, 0.2]),
)
def test_a_control_is_admitted_by_where_it_leads(x, v, u, horizon, margin):
    limit = sw.constraints.JointPositionLimit(-1.0, 1.0, horizon=horizon, margin=margin)
    limit = looking(sliders(range_="-30 30"), limit, [x], [v])
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


def test_outside_it_comes_back_and_stays_whatever_the_policy_does():
    scene = sliders(range_="-100 100")
    scene.start = [1.4], [0.0]
    filtered = sw.CBFActionFilter(scene, [sw.constraints.JointPositionLimit(-1.0, 1.0)])
    judge = Judge(filtered, lambda model, data: 1.0 - np.abs(data.qpos))
    with pytest.warns(sw.UnsafeStateWarning):
        filtered.reset(seed=0)
    rooms = [-0.4]
    for _ in range(30):
        least, end, _, info = judge.step(filtered, np.array([100.0]))
        assert least >= min(rooms[-1], 0.0) - 1e-9 or flagged(info)  # never farther out
        rooms.append(end)
        assert info["cbf/unsafe"] == (rooms[-2] < -1e-6)
    assert not info["cbf/infeasible"]
    assert np.argmax(np.array(rooms) >= -1e-6) <= 12
    assert min(rooms[12:]) >= -1e-6


def test_a_bound_that_holds_is_not_given_up_while_another_comes_back():
    scene = sliders(count=2, range_="-100 100")
    scene.start = [1.4, 0.98], [0.0, 0.0]
    filtered = sw.CBFActionFilter(scene, [sw.constraints.JointPositionLimit(-1.0, 1.0, joints=["x0", "x1"])])
    with pytest.warns(sw.UnsafeStateWarning):
        filtered.reset(seed=0)
    farthest, unflagged = 0.0, 0
    for _ in range(30):
        info = filtered.step(np.array([100.0, 100.0]))[4]
        unflagged += not flagged(info)
        farthest = max(farthest, float(scene.data.qpos[1]))
    assert unflagged > 20
    assert scene.data.qpos[0] <= 1.0 + 1e-6
    assert farthest <= 1.0 + 1e-6


def test_a_start_too_far_out_for_the_actuators_is_infeasible_and_still_driven_inwards():
    scene = sliders(range_="-1 1")
    scene.start = [1.4], [0.0]
    filtered = sw.CBFActionFilter(scene, [sw.constraints.JointPositionLimit(-1.0, 1.0, horizon=8)])
    with pytest.warns(sw.UnsafeStateWarning):
        filtered.reset(seed=0)
    infos = [filtered.step(np.array([1.0]))[4] for _ in range(12)]
    assert all(flagged(info) and info["cbf/unsafe"] for info in infos)
    assert scene.data.qpos[0] < 1.4 and scene.data.qvel[0] < 0.0


# Forecasts that are spared ------------------------------------------------------------------------------------


def count_forecasts(monkeypatch):
    calls = [0]
    real = sw.MujocoPlant.forecast

    def counted(self, *asked):
        calls[0] += 1
        return real(self, *asked)

    monkeypatch.setattr(sw.MujocoPlant, "forecast", counted)
    return calls


def test_a_reach_spares_forecasts_and_changes_nothing_else(monkeypatch):
    calls = count_forecasts(monkeypatch)
    actions = np.repeat(np.random.default_rng(0).choice([-1.0, 1.0], (40, 1)), 12, axis=0)
    seen, spent = {}, {}
    for max_decrease in (None, 0.5):  # the fastest is 2 m/s, four control steps are 0.2 s
        limit = sw.constraints.JointPositionLimit(-1.0, 1.0, horizon=4, max_decrease=max_decrease)
        filtered = sw.CBFActionFilter(sliders(range_="-10 10"), [limit])
        filtered.reset(seed=0)
        calls[0] = 0
        with warnings.catch_warnings(action="error"):
            infos = [filtered.step(a)[4] for a in actions]
        seen[max_decrease], spent[max_decrease] = np.array([i["executed_action"] for i in infos]), calls[0]
        assert sum(i["cbf/intervened"] for i in infos) > 20
    np.testing.assert_array_equal(seen[None], seen[0.5])
    assert spent[0.5] < spent[None] - 50


def test_far_from_the_limit_nothing_is_simulated(monkeypatch):
    calls = count_forecasts(monkeypatch)
    filtered = sw.CBFActionFilter(
        gym.make("Reacher-v5"), [sw.constraints.JointPositionLimit(-9.0, 9.0, ["joint0"], max_decrease=2.0)]
    )
    filtered.reset(seed=0)
    calls[0] = 0
    for _ in range(20):
        assert not filtered.step(np.array([0.01, -0.01], np.float32))[4]["cbf/intervened"]
    assert calls[0] == 0


def test_a_broken_reach_is_warned_of_once_and_dropped(monkeypatch):
    calls = count_forecasts(monkeypatch)
    scene = sliders(range_="-1 1")
    scene.start = [-0.9], [1.0]  # 5 cm in a control step
    limit = sw.constraints.JointPositionLimit(None, 2.0, joints=["x0"], horizon=4, max_decrease=0.12)
    filtered = sw.CBFActionFilter(scene, [limit])
    filtered.reset(seed=0)
    calls[0] = 0
    with pytest.warns(UserWarning) as caught:
        for _ in range(20):
            filtered.step(np.array([0.0]))
    assert [str(w.message) for w in caught] == [
        "JointPositionLimit: what is left of the limit fell by 0.15 rad or m within 3 control steps, farther than "
        "the declared max_decrease of 0.12; from now on every control is forecast"
    ]
    assert calls[0] == 17  # three steps were taken for granted
    with warnings.catch_warnings(action="error"):  # nor is it believed again in the next episode
        filtered.reset(seed=0)
        filtered.step(np.array([0.0]))
    assert calls[0] == 18


def test_a_reset_is_not_taken_for_a_broken_reach():
    scene = sliders(range_="-1 1")
    filtered = sw.CBFActionFilter(
        scene, [sw.constraints.JointPositionLimit(-1.0, 1.0, horizon=4, max_decrease=0.5)]
    )
    with warnings.catch_warnings(action="error"):
        for start in (0.0, 0.9, -0.2, 0.99):
            scene.start = [start], [0.0]
            filtered.reset(seed=0)
            for _ in range(3):
                filtered.step(np.array([0.0]))


# Numbers that are none, and machines that cannot be forecast --------------------------------------------------


def test_a_model_that_breaks_down_in_the_forecast_is_not_admitted(tmp_path, monkeypatch):
    # MuJoCo resets it, and from the reset on all looks well.
    monkeypatch.chdir(tmp_path)  # it writes a log
    scene = sliders(actuator='motor gear="1000"', range_=None)
    limit = looking(scene, sw.constraints.JointPositionLimit(-1e6, 1e6), [0.0], [0.0])
    assert limit.admits(np.array([1.0]))
    assert not limit.admits(np.array([1e9]))
    assert limit.admits(np.array([2.0]))  # and the next one is a forecast again


@kinds
def test_unlimited_actuators_are_held_too(kind):
    scene = sliders(count=2, range_=None)
    filtered = sw.CBFActionFilter(scene, [LIMITS[kind]()])
    filtered.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(40):
        info = filtered.step(rng.normal(scale=100.0, size=2))[4]
        assert not flagged(info) and not info["cbf/unsafe"]
        assert limit_left(kind, scene) >= -1e-9


def limit_left(kind, scene):
    if kind == "upright":
        return 0.0  # no actuator lifts this machine
    return {"joint position": 1.0, "workspace": 1.0}.get(kind, 0.8) - abs(
        scene.data.qpos[0] if kind in ("joint position", "workspace") else scene.data.qvel[0]
    )


@kinds
def test_a_state_that_is_no_number_admits_nothing(kind, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    limit = looking(sliders(), LIMITS[kind](), [np.nan], [0.0])
    assert not limit.admits(np.zeros(1))
    assert limit.slack(np.zeros(1)) == -np.inf


@kinds
@pytest.mark.parametrize("max_decrease", [None, 0.1])
def test_a_reading_that_is_no_number_runs_the_fallback(kind, max_decrease):
    scene = sliders()
    filtered = sw.CBFActionFilter(scene, [LIMITS[kind](max_decrease=max_decrease)])
    filtered.reset(seed=0)
    filtered.step(np.array([0.5]))
    scene.data.qvel[0] = np.nan
    with pytest.warns(sw.UnsafeStateWarning):
        info = filtered.step(np.array([1.0]))[4]
    assert info["cbf/fallback"] and info["cbf/unsafe"] and not info["cbf/refused"].any()
    np.testing.assert_array_equal(info["executed_action"], [0.0])


@kinds
@pytest.mark.parametrize("horizon", [0, -1, 1.5, True, "3", None, np.nan, np.inf])
def test_holds_is_a_whole_number(kind, horizon):
    with pytest.raises(
        ConfigurationError, match="horizon is a whole number of control intervals to look ahead"
    ):
        LIMITS[kind](horizon=horizon)


@kinds
@pytest.mark.parametrize("max_decrease", [0.0, -1.0, np.nan, np.inf, "far"])
def test_reach_is_a_positive_number_with_the_unit_of_the_limit(kind, max_decrease):
    unit = {"speed": "m/s", "joint speed": "rad/s or m/s", "workspace": "m"}.get(kind, "m or rad|rad or m")
    with pytest.raises(ConfigurationError, match=f"max_decrease must be a .*number.* in ({unit}), got"):
        LIMITS[kind](max_decrease=max_decrease)


@kinds
def test_a_plant_without_a_model_is_refused(kind):
    plant = sw.AnalyticPlant(
        f=lambda x: np.zeros(2), g=lambda x: np.ones((2, 1)), state=lambda e: np.zeros(2), control_dt=HOLD_S
    )
    with pytest.raises(UnsupportedEnvError, match=r"on an AnalyticPlant (use|write)"):
        sw.CBFActionFilter(sliders(), [LIMITS[kind]()], plant=plant)
