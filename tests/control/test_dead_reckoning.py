"""Lever arms, poses and dead reckoning against MuJoCo's own accelerometer, gyroscope and velocimeter."""

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from safe_wrappers.control.dead_reckoning import (
    DeadReckoning,
    centre_acceleration,
    lever_arm_velocity,
    rigid_transform,
)

THROWN = """
<mujoco>
  <option gravity="0.3 -0.2 -9.5" timestep="0.0005" integrator="RK4"/>
  <worldbody>
    <body name="body">
      <freejoint/>
      <inertial pos="0.05 -0.03 0.08" mass="1.7" diaginertia="0.02 0.05 0.03"/>
      <site name="imu" pos="0.3 -0.2 0.5" euler="40 -25 110"/>
    </body>
  </worldbody>
  <sensor><accelerometer site="imu"/><gyro site="imu"/><velocimeter site="imu"/></sensor>
</mujoco>
"""
EVERY = 10  # physics steps of an interval: 0.005 s


def orientation_of(quaternion):
    return Rotation.from_quat(quaternion, scalar_first=True)


@pytest.mark.parametrize("seed", range(3))
def test_lever_arms_are_those_of_mujocos_sensors(seed):
    model = mujoco.MjModel.from_xml_string(THROWN)
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    data.qpos[:], data.qvel[:] = rng.normal(size=7), 3.0 * rng.normal(size=6)
    data.xfrc_applied[1] = 5.0 * rng.normal(size=6)
    mujoco.mj_forward(model, data)
    # A free joint has its linear part in world axes and its angular part in the body's.
    body = orientation_of(data.qpos[3:])
    rate, speeding, arm = (body.apply(part) for part in (data.qvel[3:], data.qacc[3:], model.site_pos[0]))
    force, _, velocity = (body * orientation_of(model.site_quat[0])).apply(data.sensordata.reshape(3, 3))
    np.testing.assert_allclose(lever_arm_velocity(data.qvel[:3], rate, arm), velocity, atol=1e-12)
    found = centre_acceleration(force + model.opt.gravity, rate, speeding, arm)
    np.testing.assert_allclose(found, data.qacc[:3], atol=1e-10)
    assert np.linalg.norm(velocity - data.qvel[:3]) > 0.1 and np.linalg.norm(force - found) > 0.5


def test_mujocos_readings_lead_to_mujocos_motion():
    """Thrown, and pushed anew every 0.2 s; the readings are MuJoCo's alone."""
    model = mujoco.MjModel.from_xml_string(THROWN)
    data, rng, step_s = mujoco.MjData(model), np.random.default_rng(0), model.opt.timestep
    data.qvel[:] = rng.normal(size=6) * [1, 1, 1, 2, 2, 2]
    mujoco.mj_forward(model, data)
    mount = orientation_of(model.site_quat[0]).as_matrix()
    with_arm, without = (
        DeadReckoning(rigid_transform(mount, arm), model.opt.gravity)
        for arm in (model.site_pos[0], np.zeros(3))
    )
    for reckoning in (with_arm, without):
        reckoning.fix(data.qpos[:3], data.qvel[:3], orientation_of(data.qpos[3:]), data.sensordata[3:6])
    for k in range(400):
        if k % 40 == 0:
            data.xfrc_applied[1] = rng.normal(size=6) * [3, 3, 3, 0.1, 0.1, 0.1]
        mujoco.mj_forward(model, data)
        readings, axes = [data.sensordata[:6].copy()], [data.site_xmat[0].reshape(3, 3).copy()]
        for _ in range(EVERY):
            mujoco.mj_step(model, data)
            mujoco.mj_forward(model, data)
            readings.append(data.sensordata[:6].copy())
            axes.append(data.site_xmat[0].reshape(3, 3).copy())
        readings, turned = np.array(readings), Rotation.identity()
        for rate in 0.5 * (readings[1:] + readings[:-1])[:, 3:]:
            turned = turned * Rotation.from_rotvec(step_s * rate)  # as the unit does from its gyroscope alone
        in_world = np.einsum("kij,kj->ki", axes, readings[:, :3])
        middle = axes[0] @ Rotation.from_rotvec(0.5 * turned.as_rotvec()).as_matrix()
        force = (0.5 * (in_world[1:] + in_world[:-1])).mean(axis=0) @ middle
        for reckoning in (with_arm, without):
            reckoning.advance(force, turned.as_rotvec(), readings[-1, 3:], EVERY * step_s)
    end = orientation_of(data.qpos[3:])
    assert np.linalg.norm(data.qvel[3:]) > 1.0
    np.testing.assert_allclose(with_arm.angular_velocity, end.apply(data.qvel[3:]), atol=1e-3)
    assert np.linalg.norm(with_arm.position - data.qpos[:3]) < 2e-3
    assert np.linalg.norm(with_arm.velocity - data.qvel[:3]) < 2e-3
    assert (with_arm.orientation.inv() * end).magnitude() < 1e-4
    # Without the lever arm it is wrong; the orientation has nothing to do with it.
    assert np.linalg.norm(without.position - data.qpos[:3]) > 0.5
    assert np.linalg.norm(without.velocity - data.qvel[:3]) > 0.1
    assert (without.orientation.inv() * end).magnitude() < 1e-4


def test_it_takes_the_rate_between_two_readings_for_the_parabola_with_their_mean():
    """A unit that spins up as w = 3 s - 2 s^2 within one interval: only its arm moves."""
    arm, time_s, s = 0.5, 0.2, np.linspace(0.0, 1.0, 2001)[:, None]
    angle, rate = time_s * (1.5 * s**2 - 2.0 / 3.0 * s**3), 3.0 * s - 2.0 * s * s
    outwards, up = np.hstack([np.cos(angle), np.sin(angle), 0 * s]), np.array([0.0, 0.0, 1.0])
    acceleration = arm * ((3.0 - 4.0 * s) / time_s * np.cross(up, outwards) - rate**2 * outwards)
    mean = np.trapezoid(acceleration, s, axis=0)
    reckoning = DeadReckoning(rigid_transform(np.eye(3), [arm, 0.0, 0.0]), np.zeros(3))
    reckoning.fix(np.zeros(3), np.zeros(3), Rotation.identity(), np.zeros(3))
    force = Rotation.from_rotvec(0.5 * angle[-1] * up).apply(mean, inverse=True)
    reckoning.advance(force, angle[-1] * up, rate[-1] * up, time_s)
    np.testing.assert_allclose(reckoning.velocity, 0.0, atol=1e-4)
    assert np.linalg.norm(time_s * mean) > 0.4
