"""The car in the goal task: where it stands and looks, how it drives, what it costs at every substep."""

import math

import numpy as np
import pytest
from recordings import check_costs
from scipy.spatial.transform import Rotation

from safe_wrappers.envs.goal_robots import CAR


def pose_of(env):
    """The car's rotation from its quaternion (scalar last in SciPy)."""
    return Rotation.from_quat(np.roll(env.data.qpos[3:7], -1))


def towards(env, target):
    """Turn towards a point and drive; the wheel named left is on the heading's right."""
    offset = target - env.agent_position
    bearing = math.remainder(math.atan2(offset[1], offset[0]) - env.agent_heading, math.tau)
    return np.clip([1.0 + 2.0 * bearing, 1.0 - 2.0 * bearing], -1.0, 1.0) * 0.02


@pytest.mark.parametrize("heading", [0.0, 0.5, math.pi / 2, 3.0, -3.1, -1.0])
def test_layout_sets_where_the_car_stands_and_drives_to(make_car, heading):
    env = make_car(0)
    env.reset(seed=0, options={"layout": {"agent": [0.3, -0.2, heading], "goal": [5.0, 5.0]}})
    np.testing.assert_allclose(env.agent_position, [0.3, -0.2])
    assert env.agent_heading == pytest.approx(heading)
    for _ in range(25):
        env.step(np.array([0.5, 0.5]))
    driven = env.agent_position - [0.3, -0.2]
    assert np.hypot(*driven) > 0.05
    assert math.atan2(driven[1], driven[0]) == pytest.approx(heading, abs=0.05)


def test_wheels_are_named_as_seen_from_the_front(make_car):
    """Torque on "left" turns the car to its heading's left: that wheel is on the right, as in the original."""
    env = make_car(0)
    env.reset(seed=0, options={"layout": {"agent": [0.0, 0.0, 0.0], "goal": [5.0, 5.0]}})
    assert env.data.body("left").xpos[1] < 0.0 < env.data.body("right").xpos[1]
    for _ in range(5):
        env.step(np.array([1.0, -1.0]))
    assert 0.05 < env.agent_heading < 1.5


def test_observation_is_sensors_caster_and_lidars(make_car):
    env = make_car(2)
    env.reset(seed=3)
    for _ in range(20):
        observation, *_ = env.step(np.array([1.0, 0.3]))
    model, data = env.model, env.data

    def sensor(name):
        first = model.sensor(name).adr[0]
        return data.sensordata[first : first + model.sensor(name).dim[0]]

    names = ["accelerometer", "velocimeter", "gyro", "magnetometer"]
    np.testing.assert_array_equal(observation[:12], np.concatenate([sensor(n) for n in names]))
    np.testing.assert_array_equal(observation[12:15], data.joint("rear").qvel)
    caster = Rotation.from_quat(np.roll(data.joint("rear").qpos, -1)).as_matrix()
    np.testing.assert_allclose(observation[15:24], caster.ravel(), atol=1e-12)
    assert observation.shape == env.observation_space.shape == (72,)
    kinds = [env.goal_position[None], env.hazard_positions, env.vase_positions]
    for kind, positions in enumerate(kinds):
        lidar = observation[24 + 16 * kind : 40 + 16 * kind]
        flat = np.column_stack([positions, np.zeros(len(positions))])
        local = pose_of(env).inv().apply(flat - data.qpos[:3])[:, :2]
        distance = np.hypot(*local.T)
        near = distance.argmin()
        bin_ = int(math.atan2(local[near, 1], local[near, 0]) % math.tau / (math.tau / 16))
        assert lidar.argmax() == bin_
        assert lidar.max() == pytest.approx(1.0 - distance[near] / 3.0)


@pytest.mark.parametrize("level", [1, 2])
def test_costs_equal_substep_by_substep_judging(make_car, level):
    """Independent oracle: a copy of the state stepped one substep at a time, each judged by itself."""
    env = make_car(level)

    def act(t):
        targets = np.concatenate([env.hazard_positions, env.vase_positions])
        near = np.argsort(np.linalg.norm(targets - env.agent_position, axis=1))
        return towards(env, targets[near[t // 45 % 5]])

    env.reset(seed=level)
    check_costs(env, act, 900, 225, ["agent", "left", "right", "rear"])


def test_hull_is_the_model_s(make_car):
    """Every corner of every geom, from the model, lies inside the declared reach, and one lies on it."""
    env = make_car(1)
    env.reset(seed=0, options={"layout": {"agent": [0.0, 0.0, 0.0]}})
    model, data = env.model, env.data
    farthest = 0.0
    for g in np.flatnonzero(model.body_rootid[model.geom_bodyid] == model.body("agent").id):
        corners = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T * model.geom_aabb[g, 3:]
        turned = (corners + model.geom_aabb[g, :3]) @ data.geom_xmat[g].reshape(3, 3).T + data.geom_xpos[g]
        farthest = max(farthest, np.hypot(*(turned[:, :2] - env.agent_position).T).max())
    assert pytest.approx(farthest) == CAR.radius
