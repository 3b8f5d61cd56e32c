"""The goal tasks' layouts, their random placement, and the pseudo-lidar against a loop."""

import copy
import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

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


def test_layout_is_what_the_env_shows(make_env):
    env = make_env(2)
    options = {"layout": copy.deepcopy(LAYOUT)}
    env.reset(seed=3, options=options)
    assert options == {"layout": LAYOUT}
    np.testing.assert_array_equal(env.agent_position, LAYOUT["agent"][:2])
    assert env.agent_heading == pytest.approx(LAYOUT["agent"][2])
    np.testing.assert_array_equal(env.goal_position, LAYOUT["goal"])
    np.testing.assert_array_equal(env.hazard_positions, LAYOUT["hazards"])
    np.testing.assert_array_equal(env.vase_positions, LAYOUT["vases"])
    np.testing.assert_allclose(env.data.body("hazard1").xpos[:2], LAYOUT["hazards"][1])
    np.testing.assert_allclose(env.data.body("goal").xpos[:2], LAYOUT["goal"])


def test_layout_of_one_reset_does_not_reach_into_the_next(make_env):
    env = make_env(1)
    env.reset(seed=3, options={"layout": LAYOUT})
    env.reset(seed=3)
    assert len(env.hazard_positions) == 8
    assert env.agent_position.tolist() != LAYOUT["agent"][:2]


def test_parked_objects_leave_no_trace(make_env):
    env = make_env(2)
    env.reset(seed=0, options={"layout": {**LAYOUT, "hazards": [], "vases": []}})
    assert env.hazard_positions.shape == (0, 2)
    assert env.vase_positions.shape == (0, 2)
    for _ in range(100):
        obs, _, _, _, info = env.step(np.array([1.0, 0.3]))
        assert not obs[28:].any()
        assert info["cost"] == info["cost_substep"] == 0.0


@pytest.mark.parametrize(
    ("layout", "error", "message"),
    [
        ({"hazard": [[0, 0]]}, UnknownNameError, "'hazard'.*agent, goal, hazards, vases"),
        ({"hazards": [[0, 0]] * 9}, ConfigurationError, "9 hazards.*at most 8"),
        ({"vases": [[0, 0], [1, 1]]}, ConfigurationError, "2 vases.*at most 1"),
        ({"agent": [0, 0]}, ConfigurationError, r"'agent' must be \[x, y, heading\]"),
        ({"goal": [0, float("nan")]}, ConfigurationError, "'goal' must be finite"),
        ({"goal": "home"}, ConfigurationError, r"'goal' must be \[x, y\]"),
        ({"hazards": [0, 0]}, ConfigurationError, r"'hazards' must be \[\[x, y\], \.\.\.\]"),
        ({"hazards": [[0, 0], [1]]}, ConfigurationError, "'hazards' must be"),
        ([1, 2], ConfigurationError, "must be a mapping"),
    ],
)
def test_bad_layouts_are_refused_and_change_nothing(make_env, layout, error, message):
    env = make_env(1)
    env.reset(seed=0)
    before = env.data.qpos.copy()
    with pytest.raises(error, match=message):
        env.reset(seed=1, options={"layout": layout})
    np.testing.assert_array_equal(env.data.qpos, before)


def test_misspelt_option_is_refused_and_others_pass(make_env):
    env = make_env(0)
    with pytest.raises(UnknownNameError, match="did you mean 'layout'"):
        env.reset(options={"layuot": LAYOUT})
    env.reset(options={"somebody_elses": 1})


def sampled(rng, level, **given):
    counts = {"hazards": level.hazards, "vases": level.vases}
    return place_objects(rng, level.half_extent, KEEPOUTS, counts, given)


def objects(layout):
    """(position, keepout) of every object."""
    for name, keepout in KEEPOUTS.items():
        points = np.atleast_2d(layout[name])[:, :2]
        yield from ((point, keepout) for point in points)


@pytest.mark.parametrize("level", LEVELS)
def test_keepouts_and_field_hold_for_every_seed(level):
    headings = []
    for seed in range(60):
        layout = sampled(np.random.default_rng(seed), level)
        assert len(layout["hazards"]) == level.hazards and len(layout["vases"]) == level.vases
        for point, keepout in objects(layout):
            assert np.abs(point).max() <= level.half_extent - keepout
        for (p, keep_p), (q, keep_q) in itertools.combinations(objects(layout), 2):
            assert np.linalg.norm(p - q) >= keep_p + keep_q
        headings.append(layout["agent"][2])
    assert min(headings) < -2 and max(headings) > 2 and np.abs(headings).max() <= np.pi


def test_given_parts_are_kept_and_kept_clear_of_also_by_later_goals():
    given = {"agent": np.array([0.3, -0.2, 1.0]), "hazards": np.array([[1.0, 1.0]])}
    for seed in range(30):
        rng = np.random.default_rng(seed)
        layout = sampled(rng, LEVELS[2], **given)
        np.testing.assert_array_equal(layout["agent"], given["agent"])
        np.testing.assert_array_equal(layout["hazards"], given["hazards"])
        standing = {name: np.atleast_2d(layout[name])[:, :2] for name in ("agent", "hazards", "vases")}
        for goal in (layout["goal"], place_goal_beside(rng, LEVELS[2].half_extent, KEEPOUTS, standing)):
            for name, centres in standing.items():
                gaps = np.linalg.norm(goal - centres, axis=1)
                assert gaps.min() >= KEEPOUTS["goal"] + KEEPOUTS[name]


def test_no_room_is_said():
    grid = np.linspace(-0.6, 0.6, 3)
    blocked = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    with pytest.raises(ConfigurationError, match=r"no room .* \[-1\.0, 1\.0\]\^2"):
        sampled(np.random.default_rng(0), LEVELS[0], hazards=blocked)


def by_loop(targets):
    """The same readings from the definition: one object, one bin at a time."""
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
def test_equals_the_loop(targets):
    relative = np.array([t[:2] for t in targets], dtype=np.float64).reshape(-1, 2)
    kinds = np.array([t[2] for t in targets], dtype=np.intp)
    np.testing.assert_allclose(pseudo_lidar(relative, kinds, 3), by_loop(targets), atol=1e-9)
