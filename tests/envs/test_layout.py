import copy

import numpy as np
import pytest

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


@pytest.mark.parametrize("key", LAYOUT)
def test_any_subset_may_be_given(make_env, key):
    env = make_env(1)
    env.reset(seed=5, options={"layout": {key: LAYOUT[key]}})
    shown = {
        "agent": [*env.agent_position, env.agent_heading],
        "goal": env.goal_position,
        "hazards": env.hazard_positions,
        "vases": env.vase_positions,
    }
    np.testing.assert_allclose(shown.pop(key), LAYOUT[key])
    first = {name: np.array(value) for name, value in shown.items()}
    env.reset(seed=6, options={"layout": {key: LAYOUT[key]}})
    assert not np.array_equal(first["goal" if key != "goal" else "agent"], env.goal_position)


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
