"""The goal tasks with the point and the car: layouts and lidars, state, reward, and costs at every substep."""

import copy
import itertools
import math

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recordings import check_costs
from scipy.spatial.transform import Rotation

from safe_wrappers.envs.goal_env import KEEPOUTS, LEVELS
from safe_wrappers.envs.goal_robots import LIDAR_BINS, LIDAR_RANGE, pseudo_lidar
from safe_wrappers.envs.layout import place_goal_beside, place_objects
from safe_wrappers.errors import ConfigurationError, UnknownNameError

LAYOUT = {
    "agent": [0.5, -0.25, 0.75],
    "goal": [-1.0, 1.0],
    "hazards": [[1.0, 1.0], [0.0, 0.5]],
    "vases": [[-1.0, -1.0]],
}
ROBOTS = ("Point", "Car")
both_robots = pytest.mark.parametrize("robot", ROBOTS)


def towards(env, target, rng):
    """A point's or a car's action towards a place, through whatever stands in the way."""
    offset = target - env.agent_position
    bearing = math.remainder(math.atan2(offset[1], offset[0]) - env.agent_heading, math.tau)
    if env.robot.name == "car":  # the wheel named left is on the heading's right
        return np.clip([1.0 + 2.0 * bearing, 1.0 - 2.0 * bearing], -1.0, 1.0) * 0.02
    return np.clip(np.array([math.cos(bearing), bearing]) + rng.normal(0, 0.3, 2), -1, 1)


# Layouts --------------------------------------------------------------------------------------------------------


@both_robots
def test_layout_is_what_the_env_shows_for_one_episode(make_env, robot):
    env = make_env(robot, 2)
    options = {"layout": copy.deepcopy(LAYOUT)}
    env.reset(seed=3, options=options)
    assert options == {"layout": LAYOUT}
    np.testing.assert_allclose(env.agent_position, LAYOUT["agent"][:2])
    assert env.agent_heading == pytest.approx(LAYOUT["agent"][2])
    np.testing.assert_array_equal(env.goal_position, LAYOUT["goal"])
    np.testing.assert_array_equal(env.hazard_positions, LAYOUT["hazards"])
    np.testing.assert_array_equal(env.vase_positions, LAYOUT["vases"])
    np.testing.assert_allclose(env.data.body("hazard1").xpos[:2], LAYOUT["hazards"][1])
    np.testing.assert_allclose(env.data.body("goal").xpos[:2], LAYOUT["goal"])
    env.reset(seed=3)
    assert len(env.hazard_positions) == 10 and env.agent_position.tolist() != LAYOUT["agent"][:2]


def test_parked_objects_leave_no_trace(make_env):
    env = make_env("Point", 2)
    env.reset(seed=0, options={"layout": {**LAYOUT, "hazards": [], "vases": []}})
    assert env.hazard_positions.shape == env.vase_positions.shape == (0, 2)
    assert env.data.mocap_pos[1:, :2].min() > 100.0  # not drawn in the field either
    for _ in range(30):
        observation, _, _, _, info = env.step(np.array([1.0, 0.3]))
        assert not observation[28:].any() and info["cost"] == info["cost_substep"] == 0.0


@pytest.mark.parametrize(
    ("layout", "error", "message"),
    [
        ({"hazard": [[0, 0]]}, UnknownNameError, "'hazard'.*agent, goal, hazards, vases"),
        ({"hazards": [[0, 0]] * 9}, ConfigurationError, "9 hazards.*at most 8"),
        ({"agent": [0, 0]}, ConfigurationError, r"'agent' must be \[x, y, heading\]"),
        ({"goal": [0, float("nan")]}, ConfigurationError, "'goal' must be finite"),
        ({"goal": "home"}, ConfigurationError, r"'goal' must be \[x, y\]"),
        ({"hazards": [0, 0]}, ConfigurationError, r"'hazards' must be \[\[x, y\], \.\.\.\]"),
        ([1, 2], ConfigurationError, "must be a mapping"),
    ],
)
def test_bad_layouts_are_refused_and_change_nothing(make_env, layout, error, message):
    env = make_env("Point", 1)
    env.reset(seed=0)
    before = env.data.qpos.copy()
    with pytest.raises(error, match=message):
        env.reset(seed=1, options={"layout": layout})
    np.testing.assert_array_equal(env.data.qpos, before)


def test_other_bad_arguments_are_refused(make_env):
    env = make_env("Point", 0)
    with pytest.raises(UnknownNameError, match="did you mean 'layout'"):
        env.reset(options={"layuot": LAYOUT})
    env.reset(options={"somebody_elses": 1})
    with pytest.raises(ConfigurationError, match="0, 1, 2; got 3"):
        gym.make("SafePointGoal0-v0", level=3)
    grid = np.linspace(-0.6, 0.6, 3)
    blocked = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    with pytest.raises(ConfigurationError, match=r"no room .* \[-1\.0, 1\.0\]\^2"):
        sampled(np.random.default_rng(0), LEVELS[0], hazards=blocked)


def sampled(rng, level, **fixed):
    counts = {"hazards": level.hazards, "vases": level.vases}
    return place_objects(rng, level.half_extent, KEEPOUTS, counts, fixed)


@pytest.mark.parametrize("level", LEVELS)
def test_keepouts_and_field_hold_for_every_seed(level):
    headings = []
    for seed in range(40):
        layout = sampled(np.random.default_rng(seed), level)
        assert len(layout["hazards"]) == level.hazards and len(layout["vases"]) == level.vases
        objects = [
            (point, keepout)
            for name, keepout in KEEPOUTS.items()
            for point in np.atleast_2d(layout[name])[:, :2]
        ]
        for point, keepout in objects:
            assert np.abs(point).max() <= level.half_extent - keepout
        for (p, keep_p), (q, keep_q) in itertools.combinations(objects, 2):
            assert np.linalg.norm(p - q) >= keep_p + keep_q
        headings.append(layout["agent"][2])
    assert min(headings) < -2 and max(headings) > 2 and np.abs(headings).max() <= np.pi


def test_given_parts_are_kept_and_kept_clear_of_also_by_later_goals():
    fixed = {"agent": np.array([0.3, -0.2, 1.0]), "hazards": np.array([[1.0, 1.0]])}
    for seed in range(20):
        rng = np.random.default_rng(seed)
        layout = sampled(rng, LEVELS[2], **fixed)
        np.testing.assert_array_equal(layout["agent"], fixed["agent"])
        np.testing.assert_array_equal(layout["hazards"], fixed["hazards"])
        standing = {name: np.atleast_2d(layout[name])[:, :2] for name in ("agent", "hazards", "vases")}
        for goal in (layout["goal"], place_goal_beside(rng, LEVELS[2].half_extent, KEEPOUTS, standing)):
            for name, centres in standing.items():
                gaps = np.linalg.norm(goal - centres, axis=1)
                assert gaps.min() >= KEEPOUTS["goal"] + KEEPOUTS[name]


# What is observed -----------------------------------------------------------------------------------------------


def by_loop(targets):
    """The pseudo-lidars' readings from the definition: one object, one bin at a time."""
    width = 2 * math.pi / LIDAR_BINS
    readings = [[0.0] * LIDAR_BINS for _ in range(3)]
    for x, y, kind in targets:
        strength = max(0.0, 1 - math.sqrt(x * x + y * y) / LIDAR_RANGE)
        angle = math.atan2(y, x)
        angle = angle + 2 * math.pi if angle < 0 else angle
        ahead = int(angle // width)
        place = angle / width - ahead
        for shift, value in ((0, strength), (1, place * strength), (-1, (1 - place) * strength)):
            spot = (ahead + shift) % LIDAR_BINS
            readings[kind][spot] = max(readings[kind][spot], value)
    return np.array(readings).ravel()


@given(st.lists(st.tuples(st.floats(-4, 4), st.floats(-4, 4), st.integers(0, 2)), max_size=12))
def test_lidars_equal_the_loop(targets):
    relative = np.array([t[:2] for t in targets], dtype=np.float64).reshape(-1, 2)
    kinds = np.array([t[2] for t in targets], dtype=np.intp)
    np.testing.assert_allclose(pseudo_lidar(relative, kinds, 3), by_loop(targets), atol=1e-9)


def test_the_car_observes_sensors_caster_and_lidars(make_env):
    env = make_env("Car", 2)
    env.reset(seed=3)
    for _ in range(20):
        observation, *_ = env.step(np.array([1.0, 0.3]))
    data = env.data
    names = ["accelerometer", "velocimeter", "gyro", "magnetometer"]
    np.testing.assert_array_equal(observation[:12], np.concatenate([data.sensor(n).data for n in names]))
    np.testing.assert_array_equal(observation[12:15], data.joint("rear").qvel)
    caster = Rotation.from_quat(np.roll(data.joint("rear").qpos, -1)).as_matrix()
    np.testing.assert_allclose(observation[15:24], caster.ravel(), atol=1e-12)
    pose = Rotation.from_quat(np.roll(data.qpos[3:7], -1))
    targets = []
    for kind, positions in enumerate([env.goal_position[None], env.hazard_positions, env.vase_positions]):
        local = pose.inv().apply(np.column_stack([positions, np.zeros(len(positions))]) - data.qpos[:3])
        targets += [(x, y, kind) for x, y, _ in local]
    np.testing.assert_allclose(observation[24:], by_loop(targets), atol=1e-9)


@pytest.mark.parametrize("level", [0, 2])
def test_set_state_of_the_point_refreshes_everything(make_env, level):
    env = make_env("Point", level)
    env.reset(seed=1)
    qpos, qvel = env.data.qpos.copy(), env.data.qvel.copy()
    qpos[:3] = 0.25, -0.5, 2 * np.pi + 0.5
    qvel[:3] = 0.3, -0.2, 1.0
    env.set_state(qpos, qvel)
    assert env.agent_heading == pytest.approx(0.5)
    np.testing.assert_allclose(env.data.body("agent").xpos, [0.25, -0.5, 0.1], atol=1e-12)
    observation = env.observe()
    cos, sin = np.cos(0.5), np.sin(0.5)
    np.testing.assert_allclose(observation[3:5], [0.3 * cos - 0.2 * sin, -0.3 * sin - 0.2 * cos], atol=1e-12)
    assert observation[8] == pytest.approx(1.0)
    kinds = [env.goal_position[None], env.hazard_positions, env.vase_positions]
    offsets = [((x, y) - qpos[:2], kind) for kind, places in enumerate(kinds) for x, y in places]
    targets = [(cos * dx + sin * dy, cos * dy - sin * dx, kind) for (dx, dy), kind in offsets]
    np.testing.assert_allclose(observation[12:], by_loop(targets)[: len(observation) - 12], atol=1e-9)
    if level:
        env.set_state(np.r_[env.hazard_positions[0], qpos[2:]], qvel)
        assert env.step(np.zeros(2))[4]["cost_hazards"] == 1.0


# Costs and rewards ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("level", [1, 2])
@both_robots
def test_costs_equal_substep_by_substep_judging(make_env, robot, level):
    """Independent oracle: a copy of the state stepped one substep at a time, each judged by itself."""
    env = make_env(robot, level)
    rng = np.random.default_rng(level)

    def act(t):  # straight at hazards and vases in turn, so that edges are crossed often
        targets = np.concatenate([env.hazard_positions, env.vase_positions])
        if robot == "Point":
            return towards(env, targets[t // 30 % len(targets)], rng)
        near = np.argsort(np.linalg.norm(targets - env.agent_position, axis=1))
        return towards(env, targets[near[t // 45 % 5]], rng)

    env.reset(seed=level)
    steps, episode, bodies = {
        "Point": (750, 150, ["agent"]),
        "Car": (900, 225, ["agent", "left", "right", "rear"]),
    }[robot]
    check_costs(env, act, steps, episode, bodies)


def test_reset_judges_the_start(make_env):
    layout = {"agent": [0, 0, 0], "hazards": [[0.1, 0.0]], "vases": []}
    info = make_env("Point", 1).reset(seed=0, options={"layout": layout})[1]
    assert (info["cost"], info["cost_hazards"], info["cost_substep"]) == (1.0, 1.0, 1.0)
    for level, cost in ((1, 0.0), (2, 1.0)):  # the nose's tip at 0.15, the vase from 0.12
        layout |= {"hazards": [], "vases": [[0.22, 0.0]]}
        info = make_env("Point", level).reset(seed=0, options={"layout": layout})[1]
        assert info["cost"] == info["cost_vases"] == cost


def test_touch_before_the_step_is_not_charged_to_the_step(make_env):
    """MuJoCo's contacts lag one substep behind: those of the state before must not count again."""
    env = make_env("Point", 2)
    layout = {"agent": [0, 0, 0], "hazards": [], "vases": [[0.25 - 1e-6, 0.0]]}
    assert env.reset(seed=0, options={"layout": layout})[1]["cost_vases"] == 1.0
    qvel = np.zeros(env.model.nv)
    qvel[0] = -1.0  # leaving: the vase feels no force
    env.set_state(env.data.qpos.copy(), qvel)
    info = env.step(np.zeros(2))[4]
    assert (info["cost"], info["cost_substep"]) == (0.0, 0.0)


def test_reward_is_distance_gained_plus_one_on_reaching(make_env):
    env = make_env("Point", 1)
    rng = np.random.default_rng(0)
    env.reset(seed=0, options={"layout": {"hazards": [], "vases": []}})
    goals = 0
    for _ in range(600):
        goal, before = env.goal_position, np.linalg.norm(env.agent_position - env.goal_position)
        _, reward, terminated, truncated, info = env.step(towards(env, goal, rng))
        after = np.linalg.norm(env.agent_position - goal)
        reached = after <= 0.3
        goals += reached
        assert reward == pytest.approx(before - after + reached, abs=1e-12)
        assert (info["goal_met"], info["goals_reached"]) == (reached, goals)
        assert (not np.array_equal(env.goal_position, goal)) == reached and not (terminated or truncated)
    assert goals >= 2
    assert env.reset()[1]["goals_reached"] == 0


def test_sleeping_vases_change_nothing_and_wake_when_they_are_moved(make_env):
    """The same drive with sleeping switched off: same costs, same robot, up to the first touch of a vase."""
    asleep, awake = make_env("Point", 2), make_env("Point", 2)
    awake.model.opt.enableflags = 0
    layout = {"agent": [0, 0, 0], "goal": [1.5, 1.5], "hazards": [], "vases": [[0.5, 0.02], [0.705, 0.0]]}
    for env in (asleep, awake):
        env.reset(seed=0, options={"layout": layout})
    hits = 0
    for t in range(120):
        action = np.array([float(t > 40), 0.0])  # stand until the vases sleep, then drive into them
        infos = [env.step(action)[4] for env in (asleep, awake)]
        assert infos[0] == infos[1]
        np.testing.assert_allclose(asleep.data.qpos, awake.data.qpos, rtol=0, atol=1e-6)
        hits += infos[0]["cost_vases"] > 0
        if hits == 8:
            break
    assert hits == 8 and asleep.vase_positions[0, 0] > 0.51
    asleep.reset(seed=0)
    for _ in range(40):
        asleep.step(np.zeros(2))
    qpos = asleep.data.qpos.copy()
    qpos[5] = 0.5  # a vase is lifted: it must fall
    asleep.set_state(qpos, np.zeros(asleep.model.nv))
    assert asleep.step(np.zeros(2))[4]["cost_vases"] == 1.0 and asleep.data.qpos[5] < 0.499


# The machines ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("heading", [0.5, -3.1])
def test_the_car_drives_along_its_heading_and_turns_to_its_left_by_torque_on_left(make_env, heading):
    env = make_env("Car", 0)
    layout = {"agent": [0.3, -0.2, heading], "goal": [5.0, 5.0]}
    env.reset(seed=0, options={"layout": layout})
    for _ in range(25):
        env.step(np.array([0.5, 0.5]))
    driven = env.agent_position - [0.3, -0.2]
    assert np.hypot(*driven) > 0.05
    assert math.atan2(driven[1], driven[0]) == pytest.approx(heading, abs=0.05)
    env.reset(seed=0, options={"layout": layout})
    for _ in range(5):
        env.step(np.array([1.0, -1.0]))
    assert 0.05 < math.remainder(env.agent_heading - heading, math.tau) < 1.5


@both_robots
def test_hull_is_the_models(make_env, robot):
    """Every corner of every geom, from the model, lies inside the declared reach, and one lies on it."""
    env = make_env(robot, 1)
    env.reset(seed=0, options={"layout": {"agent": [0.0, 0.0, 0.0]}})
    model, data = env.model, env.data
    farthest = 0.0
    for g in np.flatnonzero(model.body_rootid[model.geom_bodyid] == model.body("agent").id):
        if model.geom(g).name == "agent" and robot == "Point":  # a sphere
            assert env.robot.hull_radius == model.geom(g).size[0]
            continue
        corners = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T * model.geom_aabb[g, 3:]
        turned = (corners + model.geom_aabb[g, :3]) @ data.geom_xmat[g].reshape(3, 3).T + data.geom_xpos[g]
        farthest = max(farthest, np.hypot(*(turned[:, :2] - env.agent_position).T).max())
    assert pytest.approx(farthest) == env.robot.radius
    assert env.hazard_radius == model.geom("hazard0").size[0]
    assert env.goal_radius == model.geom("goal").size[0]
    assert model.geom("vase0").size[0] == 0.1
