"""What constraints draw, against geometry by hand and against where the env really goes."""

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw


def looked(env):
    """The marks of each constraint in the env's present state."""
    return [list(bound.draw()) for bound in env.look()]


def of(marks, role, shape=None):
    return [m for m in marks if m.role == role and shape in (None, m.shape)]


def rods(marks, along=1):
    """Both ends of every rod; the size along it."""
    ends = [(m.position, m.size[along] * m.axes[:, 2]) for m in marks]
    return np.array([[middle - half, middle + half] for middle, half in ends])


@pytest.mark.parametrize("uncertainty", [0.0, 0.1])
def test_heading_drive_rings_every_disc_and_shows_where_braking_ends(uncertainty):
    clearance = sw.constraints.HeadingDriveClearance(
        [sw.constraints.Discs("hazard_positions", radius=0.2)], margin=0.05, uncertainty=uncertainty
    )
    env = sw.CBFActionFilter(gym.make("SafePointGoal1-v0"), [clearance])
    env.reset(seed=0)
    task = env.unwrapped
    for _ in range(20):
        env.step(np.array([1.0, 0.0], np.float32))
    (marks,) = looked(env)
    limits = rods(of(marks, "limit"), along=2)[:, 0, :2].reshape(len(task.hazard_positions), -1, 2)
    np.testing.assert_allclose(limits.mean(axis=1), task.hazard_positions, atol=1e-9)
    radii = np.linalg.norm(limits - task.hazard_positions[:, None], axis=2)
    np.testing.assert_allclose(radii, 0.25)
    way = rods(of(marks, "way", "capsule"))[:, 0, :2]
    assert len(way) == (4 if uncertainty else 3)
    np.testing.assert_allclose(way[0], task.agent_position, atol=1e-9)
    (end,) = of(marks, "way", "sphere")
    before = task.agent_position
    for _ in range(50):
        task.step(env.look()[0].backup())
    gone = np.linalg.norm(task.agent_position - before)
    assert gone > 0.01
    if uncertainty:  # the farthest stop
        assert np.linalg.norm(end.position[:2] - before) > 1.05 * gone
    else:
        np.testing.assert_allclose(end.position[:2], task.agent_position, atol=0.003)


def test_coasting_shows_where_the_car_rolls_to():
    env = sw.protect(gym.make("SafeCarGoal1-v0"))
    env.reset(seed=0)
    for _ in range(20):
        env.step(np.array([1.0, 0.9], np.float32))
    task, (marks,) = env.unwrapped, looked(env)
    np.testing.assert_allclose(rods(of(marks, "way", "capsule"))[0, 0, :2], task.agent_position, atol=1e-6)
    (end,) = of(marks, "way", "sphere")
    before = task.agent_position.copy()
    for _ in range(40):
        task.step(np.zeros(2))
    assert np.linalg.norm(task.agent_position - before) > 0.01
    np.testing.assert_allclose(end.position[:2], task.agent_position, atol=0.005)


@pytest.mark.parametrize("task", ["PointMaze_UMaze-v3", "PatrolledPointMaze-v0"])
def test_walls_are_framed_where_the_ball_touches_and_braking_ends_where_it_is_drawn(task):
    robotics = pytest.importorskip("gymnasium_robotics")
    gym.register_envs(robotics)
    walls = sw.constraints.WallClearance(margin=0.02, velocity_clip=5.0)
    env = sw.CBFActionFilter(gym.make(task), [walls])
    env.reset(seed=0, options={"reset_cell": np.array([1, 1]), "goal_cell": np.array([3, 1])})
    for _ in range(25):
        env.step(np.array([1.0, 0.2], np.float32))
    (marks,) = looked(env)
    edges = rods(of(marks, "limit"))[..., :2]
    # The wall in the middle ends 0.5 m off its centre; the ball has 0.1 m, and MuJoCo reports earlier touches.
    inner = edges[(np.abs(edges) < 1.3).all(axis=(1, 2))]
    reported = 2.0 * env.unwrapped.model.geom_margin.max()
    np.testing.assert_allclose(np.abs(inner[..., 1]).max(), 0.5 + 0.1 + 0.02 + reported)
    data = env.unwrapped.data
    np.testing.assert_allclose(rods(of(marks, "way", "capsule"))[0, 0, :2], data.qpos[:2], atol=1e-9)
    (end,) = of(marks, "way", "sphere")
    before = data.qpos[:2].copy()
    for _ in range(60):
        env.unwrapped.step(env.look()[0].backup())
    assert np.linalg.norm(data.qpos[:2] - before) > 0.05
    np.testing.assert_allclose(end.position[:2], data.qpos[:2], atol=1e-6)


def test_clearance_draws_planes_moved_by_what_is_kept_free_and_the_way_that_braking_takes():
    rail = [sw.constraints.Plane([-0.9], [1]), sw.constraints.Plane([0.9], [-1])]
    keep = sw.constraints.Clearance(rail, 8.0, bodies=["cart"], radius=0.1, margin=0.05, state_error=0.01)
    env = sw.CBFActionFilter(gym.make("InvertedPendulum-v5"), [keep])
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.array([3.0], np.float32))
    (marks,) = looked(env)
    (x, _), (v, _) = env.unwrapped.data.qpos, env.unwrapped.data.qvel
    left, right = of(marks, "keep out")
    np.testing.assert_allclose([left.position[0], right.position[0]], [-0.74, 0.74])
    for pad in (left, right):
        np.testing.assert_allclose(np.abs(pad.axes[:, 2]), [1.0, 0.0, 0.0], atol=1e-12)
    (way,) = of(marks, "way")
    ((start, end),) = rods([way])
    assert abs(v) > 0.1 and way.size[0] == 0.1
    assert sorted([start[0], end[0]]) == pytest.approx(sorted([x, x + v * abs(v) / 16.0]))
