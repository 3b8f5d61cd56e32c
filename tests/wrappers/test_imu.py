"""A sensor's IMU: its readings are MuJoCo's, and what follows from them with and without the lever arm."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from occlusion_world import STILL, Turning, straight
from scipy.spatial.transform import Rotation

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, UnknownNameError

PUSH = np.full(1, 0.004)  # about 4 rad/s²


def tracked(lever_arm=True, start_rate=0.0, world=None, **options):
    imu = sw.occlusion.Imu("eye", lever_arm=lever_arm, **options)
    sensor = sw.occlusion.Sensor(site="eye", position_std=1e-3, imu=imu)
    world = world or Turning(((0, 1, 0, -1, 0), (start_rate, 0, 0, 0, 0)))
    return sw.OcclusionPenalty(world, [straight("thing*")], sensor, tolerance=0.5)


def off(env):
    """Error of where the body is taken to be, m."""
    return np.linalg.norm(env.ego_motion.position - env.unwrapped.data.body("robot").xpos)


def test_its_readings_are_those_of_mujocos_sensors():
    env = tracked()
    raw = env.unwrapped
    spec = mujoco.MjSpec.from_string(_text(raw))
    for kind in (mujoco.mjtSensor.mjSENS_ACCELEROMETER, mujoco.mjtSensor.mjSENS_GYRO):
        spec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="eye")
    model = spec.compile()
    data = mujoco.MjData(model)
    env.reset(seed=0)
    for action in (PUSH, -PUSH, 0.3 * PUSH, PUSH):
        data.qpos[:], data.qvel[:], data.ctrl[:] = raw.data.qpos, raw.data.qvel, action
        mujoco.mj_forward(model, data)
        forces, before = [], data.site("eye").xmat.reshape(3, 3).copy()
        for _ in range(raw.frame_skip):
            mujoco.mj_forward(model, data)
            forces.append(data.site("eye").xmat.reshape(3, 3) @ data.sensordata[:3])
            mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        env.step(action)
        np.testing.assert_allclose(env.ego_motion.rate, data.sensordata[3:], atol=1e-12)
        turn = Rotation.from_matrix(before.T @ data.site("eye").xmat.reshape(3, 3))
        middle = before @ Rotation.from_rotvec(0.5 * turn.as_rotvec()).as_matrix()
        expected = np.mean(forces, axis=0) @ middle
        np.testing.assert_allclose(env.ego_motion.specific_force, expected, rtol=0.05, atol=0.03)
        assert np.linalg.norm(env.ego_motion.specific_force) > 0.3


def _text(raw):
    from occlusion_world import TEXT

    world, arm = raw.arguments
    return TEXT.format(world=world, arm=arm)


def test_the_body_stays_where_it_is_with_the_arm_and_goes_astray_without():
    ends = {}
    for lever_arm in (True, False):
        env = tracked(lever_arm, start_rate=2.0)
        env.reset(seed=0)
        errors = [(env.step(STILL), off(env))[1] for _ in range(100)]
        ends[lever_arm] = errors[-1]
        wrong = np.hypot(*(env.tracking.positions - [[1, 0], [-1, 0]]).T)
        assert (wrong < 0.05).all() if lever_arm else (wrong > 1.0).all()
        assert env.unwrapped.data.qvel[0] == pytest.approx(2.0)
    assert ends[True] < 0.01
    # closed form: the circle of the arm, less the straight line of the velocity that it began with
    arm = 0.4 * np.array([np.cos(8.0) - 1.0, np.sin(8.0) - 2.0 * 4.0])
    assert ends[False] == pytest.approx(np.hypot(*arm), rel=0.02)


def test_what_is_seen_is_put_where_the_reckoned_pose_has_it():
    env = tracked(accelerometer_std=1.0, gyro_std=0.5)
    env.reset(seed=0)
    for _ in range(40):
        observation = env.step(PUSH)[0]
    ego, raw = env.ego_motion, env.unwrapped
    mujoco.mj_kinematics(raw.model, raw.data)  # poses lag a substep behind after a step
    truth = raw.data.body("robot")
    turned = Rotation.from_matrix(ego.rotation) * Rotation.from_matrix(truth.xmat.reshape(3, 3)).inv()
    assert turned.magnitude() > 0.01 and off(env) > 0.01
    for name in ("thing", "thing2"):
        apparent = ego.position + turned.apply(raw.data.body(name).xpos - truth.xpos)
        seen = env.sensor.measured(env._sight, 2, raw.data.body(name).xpos[None], None, ego)[0]
        np.testing.assert_allclose(seen, apparent[:2], atol=1e-9)
    shown = observation[1:3] + ego.position[:2]
    np.testing.assert_allclose(shown, env.tracking.positions[0], atol=1e-9)


def test_velocities_are_put_right_by_the_reckoned_motion():
    ends = {}
    for lever_arm in (True, False):
        imu = sw.occlusion.Imu("eye", lever_arm=lever_arm)
        sensor = sw.occlusion.Sensor(site="eye", position_std=None, velocity_std=0.01, imu=imu)
        env = sw.OcclusionPenalty(
            Turning(((0, 1, 0, -1, 0), (2.0, 0, 0, 0, 0))), [straight("thing*")], sensor, tolerance=0.5
        )
        env.reset(seed=0)
        for _ in range(30):
            env.step(STILL)
        ends[lever_arm] = np.abs(env.tracking.velocities).max()
    assert ends[True] < 0.02 and ends[False] > 0.2


def test_what_moves_is_seen_to_move_in_the_reckoned_axes():
    imu = sw.occlusion.Imu("eye", accelerometer_std=1.0, gyro_std=0.5)
    sensor = sw.occlusion.Sensor(site="eye", position_std=None, velocity_std=0.01, imu=imu)
    world = Turning(((0, 1, 0, -1, 0), (1.0, 0, 0.4, 0, 0)))
    env = sw.OcclusionPenalty(world, [straight("thing")], sensor, tolerance=0.5)
    env.reset(seed=0)
    for _ in range(40):
        env.step(PUSH)
    ego, data = env.ego_motion, world.data
    mujoco.mj_kinematics(world.model, data)
    turned = ego.rotation @ data.body("robot").xmat.reshape(3, 3).T
    arm = data.site("eye").xpos - data.body("robot").xpos
    apparent = np.array([0.0, 0.4, 0.0]) - np.cross([0, 0, data.qvel[0]], arm)
    own = ego.velocity + np.cross(ego.angular_velocity, turned @ arm)
    seen = env.sensor.measured(env._sight, 2, np.zeros((1, 3)), np.array([[0.0, 0.4]]), ego)[0]
    # in the plane, as the velocities are: what noise tilts the axes by is left out
    np.testing.assert_allclose(seen, turned[:2, :2] @ apparent[:2] + own[:2], atol=1e-9)
    assert np.abs(turned - np.eye(3)).max() > 0.01


@pytest.mark.parametrize(
    ("given", "kind", "says"),
    [
        ({"site": "nose"}, UnknownNameError, "no site 'nose'"),
        ({"site": 3}, ConfigurationError, "site is the name of a site, got 3"),
        ({"accelerometer_std": -1}, ConfigurationError, "accelerometer_std must be a finite number >= 0"),
        ({"gyro_std": np.nan}, ConfigurationError, "gyro_std must be a finite number >= 0"),
        ({"fix_every_s": 0}, ConfigurationError, "fix_every_s must be a finite number > 0"),
        ({"lever_arm": 1}, ConfigurationError, "lever_arm is True or False, got 1"),
        ({"axis": 1}, UnknownNameError, "imu has no 'axis'"),
    ],
)
def test_what_it_cannot_be_is_refused(given, kind, says):
    car = sw.occlusion.Track("car0", acceleration_noise=0.1)
    with pytest.raises(kind, match=says):
        sensor = sw.occlusion.Sensor(camera="eye", imu={"site": "eye"} | given)
        sw.OcclusionPenalty(gym.make("OccludedCrossing-v0"), [car], sensor, tolerance=0.5)
