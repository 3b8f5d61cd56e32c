"""Frames in space: points in a sensor's frame, and velocity at a lever arm.

A pose is a rotation matrix (3, 3), whose columns are the frame's axes in the outer frame, and its origin (3,), m.
"""

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError

_NEXT, _AFTER = np.array([1, 2, 0]), np.array([2, 0, 1])


def lever_arm_velocity(velocity: Array, angular_velocity: Array, arm: Array) -> Array:
    """Velocity of P, m/s, from that of O, in the same axes: v_P = v_O + ω x r, with the arm r = P - O in m.

    The velocity (m/s), angular velocity (rad/s) and arm have shape (..., 3).

    Raises:
        ConfigurationError: Vectors that are not of three finite numbers.
    """
    check_vectors(velocity, angular_velocity, arm)
    return finite_result(velocity + cross(angular_velocity, arm), velocity, angular_velocity, arm)


def to_sensor(points: Array, rotation: Array, position: Array) -> Array:
    """World points (..., 3), m, in the frame of a sensor with a rotation (3, 3) and position (3,) in the world."""
    return np.asarray((points - position) @ rotation)


def from_sensor(points: Array, rotation: Array, position: Array) -> Array:
    """World points from a sensor's frame, shape (..., 3), m: the inverse of `to_sensor`."""
    return np.asarray(points @ rotation.T + position)


def cross(a: Array, b: Array) -> Array:
    """Cross product over the last axis; several times faster than `np.cross` for few vectors."""
    return np.asarray(a[..., _NEXT] * b[..., _AFTER] - a[..., _AFTER] * b[..., _NEXT])


def check_vectors(*vectors: Array) -> None:
    """Refuse arrays that are not of shape (..., 3)."""
    if any(np.shape(vector)[-1:] != (3,) for vector in vectors):
        shapes = ", ".join(str(np.shape(vector)) for vector in vectors)
        raise ConfigurationError(f"expected vectors of three numbers, of shape (..., 3), got shapes {shapes}")


def finite_result(result: Array, *vectors: Array) -> Array:
    """The result, refused where it is not finite; the error shows the vectors it was made of."""
    if not np.isfinite(result).all():
        given = ", ".join(str(np.asarray(vector).tolist()) for vector in vectors)
        raise ConfigurationError(f"expected vectors of finite numbers, got {given}")
    return result
