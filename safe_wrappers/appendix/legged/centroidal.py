"""Centroidal momentum as a function of joint rates, and what changes it.

Conventions as in `safe_wrappers.control.legged.centroidal`. Source: appendix "Centroidal momentum dynamics".
"""

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, finite_array, finite_arrays
from safe_wrappers.control.legged.centroidal import checked_inertias, checked_masses
from safe_wrappers.errors import ConfigurationError


def centroidal_momentum_matrix(
    masses: ArrayLike,
    positions: ArrayLike,
    inertias: ArrayLike,
    linear_jacobians: ArrayLike,
    angular_jacobians: ArrayLike,
) -> Array:
    """A(q), shape (..., 6, nv): `(h_lin, h_ang) = A(q) qvel`.

    Args:
        masses: Shape (..., n), kg.
        positions: Of the bodies' centres of mass, shape (..., n, 3), m.
        inertias: About them, in the world's axes, shape (..., n, 3, 3), kg m^2.
        linear_jacobians: Of those points, shape (..., n, 3, nv).
        angular_jacobians: Of the bodies' angular velocities, shape (..., n, 3, nv).
    """
    m, _, p, com = checked_masses(masses, positions)
    jac, turn = finite_arrays(linear_jacobians=linear_jacobians, angular_jacobians=angular_jacobians)
    inertia = checked_inertias(inertias)
    moved = m[..., None, None] * jac
    arm = (p - com[..., None, :])[..., None]
    orbital = np.cross(arm, moved, axis=-2).sum(axis=-3)
    angular = orbital + np.einsum("...nij,...njv->...iv", inertia, turn)
    return np.concatenate([moved.sum(axis=-3), angular], axis=-2)


def centroidal_bias_rate(
    masses: ArrayLike,
    positions: ArrayLike,
    inertias: ArrayLike,
    angular_velocities: ArrayLike,
    linear_drifts: ArrayLike,
    angular_drifts: ArrayLike,
) -> Array:
    """dA/dt qvel, shape (..., 6): the momentum rate that the motion has without joint accelerations.

    `d(h)/dt = A(q) qacc + bias`.

    Args:
        masses: Shape (..., n), kg.
        positions: Of the bodies' centres of mass, shape (..., n, 3), m.
        inertias: About them, in the world's axes, shape (..., n, 3, 3), kg m^2.
        angular_velocities: Shape (..., n, 3), rad/s.
        linear_drifts: `dJ/dt qvel` of those points, shape (..., n, 3), m/s^2.
        angular_drifts: `dJ/dt qvel` of the angular velocities, shape (..., n, 3), rad/s^2.
    """
    m, _, p, com = checked_masses(masses, positions)
    linear, turn, spin = finite_arrays(
        linear_drifts=linear_drifts, angular_drifts=angular_drifts, angular_velocities=angular_velocities
    )
    inertia = checked_inertias(inertias)
    moved = m[..., None] * linear
    own = np.einsum("...nij,...nj->...ni", inertia, turn)
    gyroscopic = np.cross(spin, np.einsum("...nij,...nj->...ni", inertia, spin))
    angular = (np.cross(p - com[..., None, :], moved) + own + gyroscopic).sum(axis=-2)
    return np.concatenate([moved.sum(axis=-2), angular], axis=-1)


def momentum_rate(
    mass: ArrayLike,
    com: ArrayLike,
    gravity: ArrayLike,
    points: ArrayLike,
    forces: ArrayLike,
    moments: ArrayLike = 0.0,
) -> tuple[Array, Array]:
    """What contact wrenches do to the momentum: rates of the linear (..., 3), N, and angular (..., 3), N m, part.

    Args:
        mass: Of the robot, shape (...), kg.
        com: Centre of mass, shape (..., 3), m.
        gravity: Acceleration, shape (..., 3), m/s^2: downwards, so its vertical part is negative where z points up.
        points: Where the forces act, shape (..., k, 3), m; k may be 0.
        forces: On the robot, shape (..., k, 3), N.
        moments: On the robot about its contact point, shape (..., k, 3), N m; a point contact gives none.
    """
    p, f, t = finite_arrays(points=points, forces=forces, moments=moments)
    if p.ndim < 2 or p.shape[-1] != 3:
        raise ConfigurationError(f"points and forces must have shape (..., k, 3), got {p.shape}")
    c, g = finite_arrays(com=com, gravity=gravity)
    m = finite_array("mass", mass)
    angular = (np.cross(p - c[..., None, :], f) + t).sum(axis=-2)
    return f.sum(axis=-2) + m[..., None] * g, angular
