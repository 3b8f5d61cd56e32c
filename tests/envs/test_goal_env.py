"""The task's own rules: reward, goals, costs at every substep, state, seeds."""

import gymnasium as gym
import numpy as np
import pytest
from recordings import check_costs

from safe_wrappers.errors import ConfigurationError


def chase(env, rng, target=None, noise=0.3):
    """An action towards a point (the goal by default), through whatever stands in the way."""
    to_goal = (env.goal_position if target is None else target) - env.agent_position
    bearing = np.arctan2(to_goal[1], to_goal[0]) - env.agent_heading
    turn = np.arctan2(np.sin(bearing), np.cos(bearing))
    return np.clip(np.array([np.cos(bearing), turn]) + rng.normal(0, noise, 2), -1, 1)


@pytest.mark.parametrize("level", [1, 2])
def test_costs_equal_substep_by_substep_judging(make_env, level):
    """Independent oracle: a copy of the state stepped one substep at a time, each judged by itself."""
    env = make_env(level)
    rng = np.random.default_rng(level)

    def act(t):
        # Straight at hazards and vases in turn, so that edges are crossed often.
        targets = np.concatenate([env.hazard_positions, env.vase_positions])
        return chase(env, rng, targets[t // 30 % len(targets)])

    env.reset(seed=level)
    check_costs(env, act, 750, 150, ["agent"])


def test_hazard_edge_cut_between_control_steps_costs_only_by_substep(make_env):
    env = make_env(1)
    hazard = np.array([0.5, 0.0])
    env.reset(seed=0, options={"layout": {"agent": [0, 0, 0], "hazards": [hazard], "vases": []}})
    qpos, qvel = env.data.qpos.copy(), env.data.qvel.copy()
    qpos[:2] = hazard + np.array([-0.015, 0.1995])  # a 28 mm chord at 2 m/s: 14 of 20 ms
    qvel[0] = 2.0
    env.set_state(qpos, qvel)
    info = env.step(np.zeros(2))[4]
    assert np.linalg.norm(env.agent_position - hazard) > 0.2
    assert (info["cost"], info["cost_hazards"], info["cost_substep"]) == (0.0, 0.0, 1.0)


def test_start_inside_a_hazard_is_reported_by_reset(make_env):
    env = make_env(1)
    layout = {"agent": [0, 0, 0], "hazards": [[0.1, 0.0]]}
    info = env.reset(seed=0, options={"layout": layout})[1]
    assert (info["cost"], info["cost_hazards"], info["cost_substep"]) == (1.0, 1.0, 1.0)


def test_touching_a_vase_costs_at_level_2_only(make_env):
    for level, cost in ((1, 0.0), (2, 1.0)):
        env = make_env(level)
        layout = {
            "agent": [0, 0, 0],
            "hazards": [],
            "vases": [[0.22, 0.0]],
        }  # nose tip at 0.15, vase from 0.12
        info = env.reset(seed=0, options={"layout": layout})[1]
        assert info["cost"] == info["cost_vases"] == cost
        info = env.step(np.zeros(2))[4]
        assert info["cost"] == info["cost_vases"] == info["cost_substep"] == cost


def test_touch_before_the_step_is_not_charged_to_the_step(make_env):
    """MuJoCo's contacts lag one substep behind: those of the state before must not count again."""
    env = make_env(2)
    layout = {"agent": [0, 0, 0], "hazards": [], "vases": [[0.25 - 1e-6, 0.0]]}
    assert env.reset(seed=0, options={"layout": layout})[1]["cost_vases"] == 1.0
    qvel = np.zeros(env.model.nv)
    qvel[0] = -1.0  # leaving: the vase feels no force
    env.set_state(env.data.qpos.copy(), qvel)
    info = env.step(np.zeros(2))[4]
    assert (info["cost"], info["cost_substep"]) == (0.0, 0.0)


def test_reward_is_distance_gained_plus_one_on_reaching(make_env):
    env = make_env(1)
    rng = np.random.default_rng(0)
    env.reset(seed=0, options={"layout": {"hazards": [], "vases": []}})
    goals = 0
    for _ in range(600):
        goal, before = env.goal_position, np.linalg.norm(env.agent_position - env.goal_position)
        _, reward, terminated, truncated, info = env.step(chase(env, rng))
        after = np.linalg.norm(env.agent_position - goal)
        reached = after <= 0.3
        goals += reached
        assert reward == pytest.approx(before - after + reached, abs=1e-12)
        assert info["goal_met"] == reached
        assert info["goals_reached"] == goals
        assert (not np.array_equal(env.goal_position, goal)) == reached
        assert not terminated
        assert not truncated
    assert goals >= 2
    assert env.reset()[1]["goals_reached"] == 0


@pytest.mark.parametrize("level", [0, 1, 2])
def test_set_state_refreshes_everything(make_env, level):
    env = make_env(level)
    env.reset(seed=1)
    qpos, qvel = env.data.qpos.copy(), env.data.qvel.copy()
    qpos[:3] = 0.25, -0.5, 2 * np.pi + 0.5
    qvel[:3] = 0.3, -0.2, 1.0
    env.set_state(qpos, qvel)
    np.testing.assert_array_equal(env.agent_position, [0.25, -0.5])
    assert env.agent_heading == pytest.approx(0.5)
    np.testing.assert_allclose(env.data.body("agent").xpos, [0.25, -0.5, 0.1], atol=1e-12)
    obs = env.observe()
    cos, sin = np.cos(0.5), np.sin(0.5)
    np.testing.assert_allclose(obs[3:5], [0.3 * cos - 0.2 * sin, -0.3 * sin - 0.2 * cos], atol=1e-12)
    assert obs[8] == pytest.approx(1.0)
    to_goal = env.goal_position - env.agent_position
    bearing = (np.arctan2(to_goal[1], to_goal[0]) - 0.5) % (2 * np.pi)
    assert obs[12:28].argmax() == int(bearing / (2 * np.pi / 16))
    assert obs[12:28].max() == pytest.approx(1 - np.linalg.norm(to_goal) / 3)
    if level:
        env.set_state(np.r_[env.hazard_positions[0], qpos[2:]], qvel)
        assert env.step(np.zeros(2))[4]["cost_hazards"] == 1.0


def test_vase_moved_by_set_state_is_awake(make_env):
    """A vase that slept must fall when it is lifted."""
    env = make_env(2)
    env.reset(seed=0)
    for _ in range(40):
        env.step(np.zeros(2))
    qpos = env.data.qpos.copy()
    qpos[5] = 0.5
    env.set_state(qpos, np.zeros(env.model.nv))
    info = env.step(np.zeros(2))[4]
    assert env.data.qpos[5] < 0.499
    assert info["cost_vases"] == 1.0


def test_sleeping_vases_change_nothing(make_env):
    """The same drive with sleeping switched off: same costs, same robot, up to the first touch of a vase."""
    asleep, awake = make_env(2), make_env(2)
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
    assert hits == 8
    assert asleep.vase_positions[0, 0] > 0.51


def test_level_that_does_not_exist():
    with pytest.raises(ConfigurationError, match="0, 1, 2; got 3"):
        gym.make("SafePointGoal0-v0", level=3)


def test_hull_is_the_model_s(make_env):
    env = make_env(1)
    size, pos = env.model.geom("pointarrow").size, env.model.geom("pointarrow").pos
    assert env.robot.hull_radius == env.model.geom("agent").size[0]
    tip = pos[0] + size[0]
    np.testing.assert_allclose(sorted(env.robot.hull_corners), [(tip, -size[1]), (tip, size[1])])
    assert env.robot.radius == pytest.approx(np.hypot(0.15, 0.05))
    assert env.model.geom("vase0").size[0] == 0.1
    assert env.hazard_radius == env.model.geom("hazard0").size[0]
    assert env.goal_radius == env.model.geom("goal").size[0]
