"""The goal tasks with the point and the car: what they observe, vases that sleep, and the machines themselves."""

import itertools
import math

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from safe_wrappers.envs.goal_robots import LIDAR_BINS, LIDAR_RANGE, pseudo_lidar


def make(robot, level):
    return gym.make(f"Safe{robot}Goal{level}-v0").unwrapped


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


@pytest.mark.parametrize("level", [0, 2])
def test_it_observes_sensors_and_lidars_right_after_set_state(level):
    env = make("Point", level)
    env.reset(seed=3)
    for _ in range(20):
        env.step(np.array([1.0, 0.3]))
    qpos, qvel = env.data.qpos.copy(), env.data.qvel.copy()
    qpos[:3], qvel[2] = [0.25, -0.5, 2 * math.pi + 0.5], 1.0
    env.set_state(qpos, qvel)
    observation, data = env.observe(), env.data
    names = ["accelerometer", "velocimeter", "gyro", "magnetometer"]
    np.testing.assert_array_equal(observation[:12], np.concatenate([data.sensor(n).data for n in names]))
    assert env.agent_heading == pytest.approx(0.5)
    place, pose = np.array([0.25, -0.5, 0.0]), Rotation.from_euler("z", 0.5)
    np.testing.assert_allclose(data.body("agent").xpos, [0.25, -0.5, 0.1], atol=1e-12)
    speed = pose.inv().apply([*qvel[:2], 0.0])
    np.testing.assert_allclose(observation[3:9], [*speed, 0.0, 0.0, 1.0], atol=1e-12)
    targets = []
    for kind, centres in enumerate([env.goal_position[None], env.hazard_positions, env.vase_positions]):
        local = pose.inv().apply(np.column_stack([centres, np.zeros(len(centres))]) - place)
        targets += [(x, y, kind) for x, y, _ in local]
    np.testing.assert_allclose(observation[12:], by_loop(targets)[: len(observation) - 12], atol=1e-9)


def test_parked_objects_leave_no_trace():
    env = make("Point", 2)
    env.reset(seed=0, options={"layout": {"hazards": [], "vases": []}})
    assert env.hazard_positions.shape == env.vase_positions.shape == (0, 2)
    assert env.data.mocap_pos[1:, :2].min() > 100.0  # not drawn in the field either
    for _ in range(30):
        observation, _, _, _, info = env.step(np.array([1.0, 0.3]))
        assert not observation[28:].any() and info["cost"] == info["cost_substep"] == 0.0
        assert np.abs(env.data.qvel[3:]).max() < 0.05  # parked apart from each other


def test_the_reward_is_clipped_at_ten():
    env = make("Point", 0)
    env.reset(seed=0, options={"layout": {"agent": [0, 0, 0], "goal": [100.0, 0.0]}})
    for speed in (1000.0, -1000.0):
        env.set_state(np.zeros(3), np.array([speed, 0.0, 0.0]))
        assert env.step(np.zeros(2))[1] == math.copysign(10.0, speed)


def test_sleeping_vases_change_nothing_and_wake_when_they_are_moved():
    """The same drive with sleeping switched off: same costs, same robot, up to the first touch of a vase."""
    asleep, awake = make("Point", 2), make("Point", 2)
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


@pytest.mark.parametrize("heading", [0.5, -3.1])
def test_the_car_drives_along_its_heading_and_turns_to_its_left_by_torque_on_left(heading):
    env, layout = make("Car", 0), {"agent": [0.3, -0.2, heading], "goal": [5.0, 5.0]}
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


def test_the_cars_hull_is_the_models():
    """Every corner of every geom lies inside the declared outline, and some lie on it."""
    env = make("Car", 1)
    env.reset(
        seed=0, options={"layout": {"agent": [0.0, 0.0, -math.pi / 2]}}
    )  # the body's axes are the world's
    model, data, corners = env.model, env.data, []
    for g in np.flatnonzero(model.body_rootid[model.geom_bodyid] == model.body("agent").id):
        box = np.array(list(itertools.product([-1, 1], repeat=3))) * model.geom_aabb[g, 3:]
        turned = (box + model.geom_aabb[g, :3]) @ data.geom_xmat[g].reshape(3, 3).T + data.geom_xpos[g]
        corners.append(turned[:, :2] - env.agent_position)
    corners = np.concatenate(corners)
    one_side = np.array(env.robot.hull_corners)
    outline = np.concatenate([one_side, [-1.0, 1.0] * one_side])
    beyond = ConvexHull(outline).equations @ np.column_stack([corners, np.ones(len(corners))]).T
    assert beyond.max() == pytest.approx(0.0, abs=1e-9)
    assert env.hazard_radius == model.geom("hazard0").size[0]
    assert env.goal_radius == model.geom("goal").size[0]
    assert model.geom("vase0").size[0] == 0.1
