"""Dead reckoning on MuJoCo's own accelerometer and gyroscope, and against closed forms."""

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from safe_wrappers.control.dead_reckoning import DeadReckoning, rigid_transform

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
  <sensor><accelerometer site="imu"/><gyro site="imu"/></sensor>
</mujoco>
"""
EVERY = 10  # physics steps of an interval: 0.005 s


def thrown(lever_arm, seconds=2.0, seed=0):
    """Errors of the reckoned position (m), velocity and orientation (rad) at the end; readings are MuJoCo's alone."""
    model = mujoco.MjModel.from_xml_string(THROWN)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(seed)
    data.qvel[:] = np.concatenate([rng.normal(size=3), rng.normal(0.0, 2.0, 3)])
    mujoco.mj_forward(model, data)
    mount = Rotation.from_quat(model.site_quat[0], scalar_first=True).as_matrix()
    arm = model.site_pos[0] if lever_arm else np.zeros(3)
    reckoning = DeadReckoning(rigid_transform(mount, arm), model.opt.gravity)
    start = Rotation.from_quat(data.qpos[3:], scalar_first=True)
    reckoning.fix(data.qpos[:3], data.qvel[:3], start, data.sensordata[3:])
    step_s = model.opt.timestep
    for k in range(round(seconds / step_s / EVERY)):
        data.xfrc_applied[1] = (
            rng.normal(size=6) * [3, 3, 3, 0.1, 0.1, 0.1] if k % 40 == 0 else data.xfrc_applied[1]
        )
        mujoco.mj_forward(model, data)
        readings, axes = [data.sensordata.copy()], [data.site_xmat[0].reshape(3, 3).copy()]
        for _ in range(EVERY):
            mujoco.mj_step(model, data)
            mujoco.mj_forward(model, data)
            readings.append(data.sensordata.copy())
            axes.append(data.site_xmat[0].reshape(3, 3).copy())
        readings = np.array(readings)
        between = 0.5 * (readings[1:] + readings[:-1])
        turned = Rotation.identity()
        for rate in between[:, 3:]:  # what the unit integrates, from its gyroscope alone
            turned = turned * Rotation.from_rotvec(step_s * rate)
        in_world = np.einsum("kij,kj->ki", np.array(axes), readings[:, :3])
        mean = (0.5 * (in_world[1:] + in_world[:-1])).mean(axis=0)
        middle = axes[0] @ Rotation.from_rotvec(0.5 * turned.as_rotvec()).as_matrix()
        reckoning.advance(mean @ middle, turned.as_rotvec(), readings[-1, 3:], EVERY * step_s)
    end = Rotation.from_quat(data.qpos[3:], scalar_first=True)
    assert np.linalg.norm(data.qvel[3:]) > 1.0
    np.testing.assert_allclose(reckoning.angular_velocity, end.apply(data.qvel[3:]), atol=1e-3)
    return (
        np.linalg.norm(reckoning.position - data.qpos[:3]),
        np.linalg.norm(reckoning.velocity - data.qvel[:3]),
        (reckoning.orientation.inv() * end).magnitude(),
    )


@pytest.mark.parametrize("seed", range(3))
def test_mujocos_readings_lead_to_mujocos_motion(seed):
    position, velocity, angle = thrown(True, seed=seed)
    assert position < 2e-3 and velocity < 2e-3 and angle < 1e-4
    position, velocity, angle = thrown(False, seed=seed)
    assert position > 0.5 and velocity > 0.1, "without the lever arm it is wrong"
    assert angle < 1e-4, "the orientation has nothing to do with it"


def test_it_takes_the_rate_between_two_readings_for_the_parabola_with_their_mean():
    """A unit that spins up as w = 3 s - 2 s^2 within one interval: only its arm moves."""
    arm, time_s = np.array([0.5, 0.0, 0.0]), 0.2
    s = np.linspace(0.0, 1.0, 2001)
    rate = 3.0 * s - 2.0 * s * s
    angle = time_s * (1.5 * s**2 - 2.0 / 3.0 * s**3)
    alpha = (3.0 - 4.0 * s) / time_s
    outwards = np.stack([np.cos(angle), np.sin(angle), 0 * s], axis=1)
    sideways = np.stack([-np.sin(angle), np.cos(angle), 0 * s], axis=1)
    acceleration = 0.5 * (alpha[:, None] * sideways - (rate**2)[:, None] * outwards)
    mean = np.trapezoid(acceleration, s, axis=0)
    reckoning = DeadReckoning(rigid_transform(np.eye(3), arm), np.zeros(3))
    reckoning.fix(np.zeros(3), np.zeros(3), Rotation.identity(), np.zeros(3))
    middle = Rotation.from_rotvec([0, 0, 0.5 * angle[-1]])
    turn, end = np.array([0, 0, angle[-1]]), np.array([0, 0, rate[-1]])
    reckoning.advance(middle.apply(mean, inverse=True), turn, end, time_s)
    np.testing.assert_allclose(reckoning.velocity, 0.0, atol=1e-4)
    assert np.linalg.norm(time_s * mean) > 0.4
