"""Acceleration at a lever arm, and poses.

The sensor sits at P, the body turns about O, the lever arm is r = P - O; then, all in the same axes,

    v_P = v_O + ω x r,        a_P = a_O + α x r + ω x (ω x r):

the second term of the acceleration is tangential, the third centripetal.

Source: appendix "Spatial coordinate frames and lever-arm kinematics".
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, finite_array
from safe_wrappers.control.numerics.spatial import check_vectors, cross, finite_result
from safe_wrappers.errors import ConfigurationError

if TYPE_CHECKING:
    from scipy.spatial.transform import RigidTransform

GRAVITY: Final = (0.0, 0.0, -9.81)
"""m/s², in a world whose z points up: MuJoCo's default."""

_ROTATION_TOLERANCE = 1e-6


def lever_arm_acceleration(
    acceleration: Array, angular_velocity: Array, angular_acceleration: Array, arm: Array
) -> Array:
    """Acceleration of P, m/s², from that of O.

    Args:
        acceleration: Of O, shape (..., 3), m/s²: the derivative of its velocity, free of gravity's sign conventions.
        angular_velocity: Of the body, shape (..., 3), rad/s.
        angular_acceleration: Of the body, shape (..., 3), rad/s².
        arm: P - O, shape (..., 3), m, in the same axes as the others.

    Raises:
        ConfigurationError: Vectors that are not of three finite numbers.
    """
    check_vectors(acceleration, angular_velocity, angular_acceleration, arm)
    extra = _lever_terms(angular_velocity, angular_acceleration, arm)
    return finite_result(acceleration + extra, acceleration, angular_velocity, angular_acceleration, arm)


def centre_acceleration(
    acceleration: Array, angular_velocity: Array, angular_acceleration: Array, arm: Array
) -> Array:
    """Acceleration of O, m/s², from that of P: the inverse of `lever_arm_acceleration`."""
    check_vectors(acceleration, angular_velocity, angular_acceleration, arm)
    extra = _lever_terms(angular_velocity, angular_acceleration, arm)
    return finite_result(acceleration - extra, acceleration, angular_velocity, angular_acceleration, arm)


def rigid_transform(rotation: ArrayLike, position: ArrayLike) -> RigidTransform:
    """A pose as SciPy's transform, refused if it is none (SciPy would turn any matrix into a rotation near it).

    Args:
        rotation: Shape (3, 3), or (n, 3, 3): columns are the frame's axes in the outer frame.
        position: Of its origin there, shape (3,) or (n, 3), m.

    Raises:
        ConfigurationError: Not a rotation (not orthonormal, or a reflection), other shapes, not finite.
    """
    matrix = finite_array("rotation", rotation)
    origin = finite_array("position", position)
    if matrix.ndim not in (2, 3) or matrix.shape[-2:] != (3, 3) or origin.shape != matrix.shape[:-1]:
        raise ConfigurationError(
            f"expected a rotation (3, 3) and a position (3,), or n of each, got {matrix.shape} and {origin.shape}"
        )
    uneven = np.abs(matrix @ matrix.swapaxes(-1, -2) - np.eye(3)).max(initial=0.0)
    if uneven > _ROTATION_TOLERANCE or (np.linalg.det(matrix) < 0.0).any():
        raise ConfigurationError(
            f"expected a rotation: columns of length 1 at right angles (here off by up to {uneven:.3g}) and "
            f"determinant +1 (here {np.linalg.det(matrix).tolist()}); got {matrix.tolist()}"
        )
    from scipy.spatial.transform import RigidTransform, Rotation  # here: SciPy takes a while to import

    return RigidTransform.from_components(origin, Rotation.from_matrix(matrix))


def _lever_terms(angular_velocity: Array, angular_acceleration: Array, arm: Array) -> Array:
    return cross(angular_acceleration, arm) + cross(angular_velocity, cross(angular_velocity, arm))
