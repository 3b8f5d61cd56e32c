"""Lever arms and poses against MuJoCo's own sensors, finite differences and 4x4 matrices."""

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import RigidTransform, Rotation

from safe_wrappers.control.dead_reckoning import (
    centre_acceleration,
    from_sensor,
    lever_arm_velocity,
    rigid_transform,
    to_sensor,
)

SPINNING = """
<mujoco>
  <option gravity="0.3 -0.2 -9.5"/>
  <worldbody>
    <body name="body">
      <freejoint/>
      <inertial pos="0.05 -0.03 0.08" mass="1.7" diaginertia="0.02 0.05 0.03"/>
      <site name="imu" pos="0.3 -0.2 0.5" euler="40 -25 110"/>
    </body>
  </worldbody>
  <sensor>
    <accelerometer site="imu"/> <gyro site="imu"/> <velocimeter site="imu"/>
  </sensor>
</mujoco>
"""
VECTORS = arrays(np.float64, 3, elements=st.floats(-10.0, 10.0))


@pytest.fixture(scope="module")
def spinning():
    model = mujoco.MjModel.from_xml_string(SPINNING)
    return model, mujoco.MjData(model)


def thrown(spinning, seed):
    """A random state and wrench: velocity, angular velocity, their derivatives (world axes), orientation, sensors."""
    model, data = spinning
    rng = np.random.default_rng(seed)
    mujoco.mj_resetData(model, data)
    turn = Rotation.random(rng=rng)
    data.qpos[:] = [*rng.normal(size=3), *turn.as_quat(scalar_first=True)]
    data.qvel[:] = rng.normal(size=6) * 3.0
    data.xfrc_applied[1] = rng.normal(size=6) * 5.0
    mujoco.mj_forward(model, data)
    # A free joint has its linear part in world axes and its angular part in the body's.
    return {
        "velocity": data.qvel[:3].copy(),
        "turning": turn.apply(data.qvel[3:]),
        "acceleration": data.qacc[:3].copy(),
        "speeding": turn.apply(data.qacc[3:]),
        "orientation": turn,
        "sensors": data.sensordata.reshape(3, 3).copy(),
    }


def extrinsics(model):
    return RigidTransform.from_components(
        model.site_pos[0], Rotation.from_quat(model.site_quat[0], scalar_first=True)
    )


@pytest.mark.parametrize("seed", range(5))
def test_mujocos_velocimeter_reads_the_lever_arms_velocity(spinning, seed):
    s, mount = thrown(spinning, seed), extrinsics(spinning[0])
    arm = s["orientation"].apply(mount.translation)
    at_site = lever_arm_velocity(s["velocity"], s["turning"], arm)
    reading = (s["orientation"] * mount.rotation).apply(s["sensors"][2])
    np.testing.assert_allclose(at_site, reading, atol=1e-12)
    assert np.linalg.norm(reading - s["velocity"]) > 0.1, "without compensation it would be wrong"


@pytest.mark.parametrize("seed", range(5))
def test_mujocos_imu_gives_the_centres_acceleration_back(spinning, seed):
    model, _ = spinning
    s, mount = thrown(spinning, seed), extrinsics(spinning[0])
    sensor, (force, gyro, _) = s["orientation"] * mount.rotation, s["sensors"]
    read = sensor.apply(force) + model.opt.gravity, sensor.apply(gyro), s["speeding"]
    found = centre_acceleration(*read, s["orientation"].apply(mount.translation))
    np.testing.assert_allclose(found, s["acceleration"], atol=1e-10)
    wrong = centre_acceleration(*read, np.zeros(3))
    assert np.linalg.norm(wrong - s["acceleration"]) > 0.5, "without the lever arm it would be wrong"


@given(arrays(np.float64, (5, 3), elements=st.floats(-10.0, 10.0)), VECTORS, VECTORS, VECTORS)
def test_points_go_to_the_sensor_and_back(points, rotvec, position, mounted):
    body = rigid_transform(Rotation.from_rotvec(rotvec).as_matrix(), position)
    mount = rigid_transform(Rotation.from_rotvec(mounted).as_matrix(), 0.1 * mounted)
    pose = body * mount
    np.testing.assert_allclose(pose.as_matrix(), body.as_matrix() @ mount.as_matrix(), atol=1e-12)
    rotation, origin = pose.rotation.as_matrix(), pose.translation
    seen = to_sensor(points, rotation, origin)
    np.testing.assert_allclose(seen, pose.inv().apply(points), atol=1e-12)
    np.testing.assert_allclose(from_sensor(seen, rotation, origin), points, atol=1e-12)
    np.testing.assert_allclose(to_sensor(points[2], rotation, origin), seen[2], atol=1e-14)
