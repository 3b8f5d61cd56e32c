"""What an accelerometer off the axis reads, and the acceleration of the body from that.

The conventions are those of `safe_wrappers.control.estimation.lever_arm`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, finite_arrays
from safe_wrappers.control.estimation.lever_arm import GRAVITY, centre_acceleration, lever_arm_acceleration

if TYPE_CHECKING:
    from scipy.spatial.transform import RigidTransform, Rotation


def imu_specific_force(
    acceleration: ArrayLike,
    angular_velocity: ArrayLike,
    angular_acceleration: ArrayLike,
    orientation: Rotation,
    extrinsics: RigidTransform,
    gravity: ArrayLike = GRAVITY,
) -> Array:
    """What an accelerometer at P reads: its acceleration less gravity, in its own axes.

    Args:
        acceleration: Of the body's origin O, world axes, shape (..., 3), m/s².
        angular_velocity: World axes, shape (..., 3), rad/s.
        angular_acceleration: World axes, shape (..., 3), rad/s².
        orientation: Of the body in the world; one, or one for each of a single leading axis.
        extrinsics: Pose of the sensor in the body.
        gravity: World axes, shape (3,), m/s².

    Returns:
        Shape (..., 3), m/s². At rest it is minus gravity: 9.81 m/s² upwards.

    Raises:
        ConfigurationError: Vectors that are not of three finite numbers.
    """
    a, w, dw, g = finite_arrays(
        acceleration=acceleration,
        angular_velocity=angular_velocity,
        angular_acceleration=angular_acceleration,
        gravity=gravity,
    )
    at_sensor = lever_arm_acceleration(a, w, dw, orientation.apply(extrinsics.translation))
    return np.asarray((orientation * extrinsics.rotation).apply(at_sensor - g, inverse=True))


def centre_acceleration_from_imu(
    specific_force: ArrayLike,
    rate: ArrayLike,
    rate_derivative: ArrayLike,
    orientation: Rotation,
    extrinsics: RigidTransform,
    gravity: ArrayLike = GRAVITY,
) -> Array:
    """Acceleration of the body's origin, m/s², world axes, from an IMU at P: undoes `imu_specific_force`.

    Args:
        specific_force: What the accelerometer reads, sensor axes, shape (..., 3), m/s².
        rate: What the gyroscope reads, sensor axes, shape (..., 3), rad/s.
        rate_derivative: Time derivative of what the gyroscope reads, shape (..., 3), rad/s². In turning axes it is
            still the angular acceleration, as the angular velocity does not turn itself.
        orientation: Of the body in the world; one, or one for each of a single leading axis.
        extrinsics: Pose of the sensor in the body.
        gravity: World axes, shape (3,), m/s².

    Raises:
        ConfigurationError: Vectors that are not of three finite numbers.
    """
    f, w, dw, g = finite_arrays(
        specific_force=specific_force, rate=rate, rate_derivative=rate_derivative, gravity=gravity
    )
    sensor = orientation * extrinsics.rotation
    at_sensor = sensor.apply(f) + g
    arm = orientation.apply(extrinsics.translation)
    return centre_acceleration(at_sensor, sensor.apply(w), sensor.apply(dw), arm)
