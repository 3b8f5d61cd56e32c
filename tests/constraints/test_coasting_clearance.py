"""CoastingClearance: what it admits, suggests as a `Detour`, refuses and says."""

import warnings
from functools import cache

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import Asked

import safe_wrappers as sw
from benchmarks.car_drivers import goal_seeking
from safe_wrappers.errors import UnsafeStateWarning

FULL = np.array([1.0, 1.0])
BACK = -FULL
NONE = np.zeros(2)
SQUARE = [[0.16, 0.18], [0.16, -0.18], [-0.16, 0.18], [-0.16, -0.18]]


def bound(hazards, level=1, vases=(), heading=0.0, speed_up=0, idle=0, **options):
    """A filtered car at the origin after full drive and idle steps without the filter, and its constraint."""
    options = {
        "keep_out": [sw.constraints.Discs("hazard_positions", 0.2)],
        "robot_model_attr": "robot_model",
    } | options
    env = sw.CBFActionFilter(
        gym.make(f"SafeCarGoal{level}-v0"), [sw.constraints.CoastingClearance(**options)]
    )
    layout = {"agent": [0.0, 0.0, heading], "goal": [9.0, 9.0], "hazards": hazards, "vases": list(vases)}
    env.reset(seed=0, options={"layout": layout})
    for control in speed_up * [FULL] + idle * [NONE]:
        env.unwrapped.step(control)
    constraint = Asked(env.constraints[0], env.plant)
    env.plant.observe()
    return env, constraint, env.plant


def least_way(env, control, point=(0.0, 0.0), steps=25):
    """Smallest distance of the origin to a point while a control is held for a step and then none: on a copy."""
    raw = env.unwrapped
    data = mujoco.MjData(raw.model)
    mujoco.mj_copyData(data, raw.model, raw.data)
    data.ctrl[:] = control
    least = np.inf
    for k in range(steps * raw.frame_skip):
        if k == raw.frame_skip:
            data.ctrl[:] = 0.0
        mujoco.mj_step(raw.model, data)
        least = min(least, np.hypot(*(data.qpos[:2] - point)))
    return least


@cache
def place_after(speed_up, idle):
    return bound([[5.0, 0.0]], speed_up=speed_up, idle=idle)[0].unwrapped.agent_position


def beside(gap, speed_up=0, side=1.0, idle=0):
    """A car with this gap to a hazard before it, or behind it, its constraint, and where the hazard is."""
    x, y = place_after(speed_up, idle)
    hazard = [x + side * (0.2 + gap), y]
    return *bound([hazard], speed_up=speed_up, idle=idle)[:2], hazard


@pytest.mark.parametrize("side", [-1.0, 1.0])  # what it rolls away from is as near as now; and before it
@pytest.mark.parametrize("speed_up", [0, 6, 30])
def test_a_control_is_admitted_iff_its_way_to_rest_keeps_the_margin(speed_up, side):
    """Independent: the env's own data, stepped on without any control."""
    for gap in (0.01, 0.02, 0.053, 0.06, 0.08, 0.2):
        env, constraint, hazard = beside(gap, speed_up, side)
        at_rest = least_way(env, NONE, hazard) - 0.2
        assert constraint.value() == pytest.approx(min(at_rest, gap), abs=1e-3)
        for control in (FULL, BACK, NONE, np.array([1.0, -1.0]), np.array([0.006, 0.0])):
            way = least_way(env, control, hazard) - 0.2
            if abs(way - 0.005) > 1e-3 and at_rest >= 0.006:  # else too close to call, or inside the margin
                assert constraint.admits(control) == (way > 0.005)


def test_no_control_is_admitted_where_nothing_leaves_more_and_the_state_is_unsafe_where_it_is_not_clear():
    env = bound([[5.0, 0.0]], speed_up=30)[0]
    way = 5.0 - place_after(30, 0)[0] - least_way(env, NONE, [5.0, 0.0])
    for slack in (0.002, -0.002):  # less than the margin, but clear; not clear
        constraint = beside(way + slack, 30)[1]
        assert constraint.least == pytest.approx(slack, abs=1e-4)
        assert constraint.admits(NONE) and constraint.admits(-NONE)  # minus zero is no control, too
        assert not constraint.admits(FULL) and not constraint.admits(BACK)


def test_far_from_everything_nothing_is_forecast():
    env, constraint, plant = bound([[3.0, 0.0]], max_decrease=0.05, max_decrease_per_speed=0.13)
    constraint.coasting.run = None  # any forecast would fail
    assert constraint.admits(FULL)
    assert constraint.value() == pytest.approx(2.8)
    for _ in range(10):
        env.unwrapped.step(np.array([1.0, -1.0]))  # turning moves no origin
    plant.observe()
    room = np.linalg.norm([3.0, 0.0] - env.unwrapped.agent_position) - 0.2
    assert constraint.value() == pytest.approx(room - 0.13 * np.hypot(*env.unwrapped.data.qvel[:2]), abs=1e-6)


def test_a_reach_that_is_broken_is_dropped_with_a_warning_and_more_discs_come_into_play():
    # Two inside the margin, one beyond the declared reach.
    hazards = [[0.203, 0.0], [-0.2035, 0.0], [0.0, 0.2105]]
    _, constraint, _ = bound(hazards, max_decrease=0.001)
    with pytest.warns(UserWarning, match=r"farther than the declared max_decrease of 0\.001 m"):
        assert not constraint.admits(FULL)
    with warnings.catch_warnings(action="error"):
        assert constraint.admits(NONE) and not constraint.admits(0.018 * FULL)  # the torque acts up to 0.02


def test_the_outline_counts_where_it_should():
    """Beside a vase that its front corner would touch, the car may not turn to it; its origin is far enough."""
    vases = [[0.18, 0.16 + 0.1415 + 0.008]]
    outlined = {"untouched": [sw.constraints.Discs("vase_positions", 0.1415)], "outline": SQUARE}
    _, constraint, _ = bound([], 2, vases, **outlined)
    assert constraint.value() == pytest.approx(0.008, abs=1e-6)
    assert constraint.admits(NONE)
    assert [constraint.admits(np.array([s, -s])) for s in (1.0, -1.0)] == [False, True]
    _, bare, _ = bound([], 2, vases, keep_out=[sw.constraints.Discs("vase_positions", 0.1415)])
    assert all(bare.admits(np.array([s, -s])) for s in (1.0, -1.0))


def test_from_inside_the_best_way_out_is_admitted_and_it_drives_out():
    with pytest.warns(UnsafeStateWarning):
        env, constraint, _ = bound([[0.12, 0.05]])
    out = constraint.backup()
    assert constraint.admits(out) and constraint.slack(out) > constraint.value()
    assert not constraint.admits(-out) and not constraint.admits(NONE)
    with warnings.catch_warnings(action="ignore"):
        infos = [env.step(FULL.astype(np.float32))[4] for _ in range(60)]
    assert infos[0]["cbf/unsafe"] and infos[0]["cbf/intervened"]
    inside = [bool(info["cost_substep"]) for info in infos]
    assert inside == sorted(inside, reverse=True) and sum(inside) < 40


def test_a_detour_keeps_its_side_and_else_passes_on_the_right_what_is_on_the_left():
    limit = bound([[0.28, 0.02]], detour=True)[1].bound

    def turns(memory):
        """The first way around: which way it turns."""
        limit.observe(memory)
        first, second = limit.candidates(FULL)[0]
        return float(np.sign(first - second))

    left, right = (turns({"detour": (side, 1)}) for side in (1.0, -1.0))
    assert left == -right != 0.0
    assert turns({}) == turns({"detour": (1.0, 0)}) == right  # the other side has not been needed for long
    assert limit.executed(FULL)["detour"] == (-1.0, 25)


def test_a_car_that_is_wedged_between_obstacles_turns_the_other_way():
    """Without that it stands there in 810 of these steps."""
    env = sw.StuckMonitor(sw.protect(gym.make("SafeCarGoal2-v0")), progress=0.1)
    driver = goal_seeking(env.unwrapped, np.random.default_rng(0))
    env.reset(seed=1_000_002)
    assert sum(env.step(driver())[4]["cbf/stuck"] for _ in range(1000)) < 500


def protected(agent, **obstacles):
    env = sw.protect(gym.make("SafeCarGoal2-v0"))
    layout = {"agent": agent, "goal": [9.0, 9.0], "hazards": [], **obstacles}
    env.reset(seed=0, options={"layout": layout})
    return env


@pytest.mark.parametrize(("side", "ahead"), [(1.0, 0.12), (1.0, -0.1), (-1.0, -0.1)])
def test_a_refused_turn_on_the_spot_makes_room_for_itself(side, ahead):
    """Without that the car turns by less than 0.8 rad, and stands."""
    env, turn = protected([0.0, 0.0, 0.0], vases=[[ahead, 0.155 + 0.1415 + 0.008]]), np.array([side, -side])
    limit = Asked(env.constraints[0], env.plant)
    limit.bound.observe({})
    wheel, other, away, back = (limit.slack(way) for way in limit.bound.candidates(turn)[:4])
    assert wheel >= other and away >= back  # what leaves more comes first
    infos = [env.step(turn)[4] | {"heading": env.unwrapped.agent_heading} for _ in range(100)]
    assert all(info["cbf/margin"] >= 0.0 and not info["cost_substep"] for info in infos)
    assert abs(np.unwrap([info["heading"] for info in infos])[-1]) > 3.5


@pytest.mark.parametrize("x", [0.3335, 0.33356, 0.334])
def test_a_wedged_car_leaves_in_halved_steps(x):
    """Between a hazard and a vase, where every full step that a turn on the spot leads to is refused."""
    env = protected([x, -1.2588, -0.3418], hazards=[[0.3844, -1.0589]], vases=[[0.2588, -1.5346]])
    for _ in range(150):
        env.step(np.array([0.73, -0.26]))
    assert np.hypot(*(env.unwrapped.agent_position - [x, -1.2588])) > 0.05


def test_what_does_not_rest_within_the_horizon_is_refused_however_far_it_stays_away():
    for horizon, rests in ((2, False), (12, True)):
        env, limit, _ = bound([[5.0, 0.0]], speed_up=30, horizon=horizon)
        far = 5.0 - 0.2 - env.unwrapped.agent_position[0]
        for control in (FULL, NONE, BACK):
            assert limit.admits(control) == rests
            assert np.isfinite(limit.value()).all() == rests
            slack = limit.slack(control)
            assert far - 0.3 < slack < far if rests else slack == -np.inf


@pytest.mark.parametrize("gap", [0.001, 0.0045])
@pytest.mark.parametrize(("side", "out"), [(1.0, BACK), (-1.0, FULL)])
def test_parked_inside_the_margin_only_the_way_out_is_open(gap, side, out):
    limit = beside(gap, side=side, idle=20)[1]  # it settles on its wheels
    assert 0.0 < float(limit.value()[0]) < 0.005
    assert limit.admits(out) and not limit.admits(-out)
