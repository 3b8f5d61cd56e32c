"""Centroidal momentum: what all bodies of a robot do together, seen from their centre of mass.

Source: appendix "Centroidal momentum dynamics". Only forces from outside change it:

    d(h_lin)/dt = m c'' = sum f_k + m g,    d(h_ang)/dt = sum [(p_k - c) x f_k + tau_k].

Conventions, of everything here: vectors are in the world's axes; forces and moments are those on the robot;
`h_lin = m c'`; `h_ang` is about the (moving) centre of mass, so that gravity does not appear in its rate; where both
are stacked, the linear part comes first (Orin and Goswami put the angular part first).

What it is not: the momentum says which wrench from outside a motion needs. That contacts can give it
(`friction_cone`) and motors can make them give it (`whole_body`) are questions of their own; and a model of the
linear part alone mispredicts the moments that the contacts must give.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.control.numerics.finite import finite_arrays
from safe_wrappers.errors import ConfigurationError

Array = NDArray[np.float64]


class CentroidalMomentum(NamedTuple):
    """Of several bodies together.

    Attributes:
        mass: Shape (...), kg.
        com: Centre of mass, shape (..., 3), m.
        com_velocity: Shape (..., 3), m/s.
        linear: `mass * com_velocity`, shape (..., 3), kg m/s.
        angular: About the centre of mass, shape (..., 3), kg m^2/s.
    """

    mass: Array
    com: Array
    com_velocity: Array
    linear: Array
    angular: Array


def centroidal_momentum(
    masses: ArrayLike,
    positions: ArrayLike,
    velocities: ArrayLike,
    inertias: ArrayLike,
    angular_velocities: ArrayLike,
) -> CentroidalMomentum:
    """Momentum of n rigid bodies.

    Args:
        masses: Shape (..., n), kg, their sum positive.
        positions: Of the bodies' own centres of mass, shape (..., n, 3), m.
        velocities: Of the same points, shape (..., n, 3), m/s.
        inertias: About them, in the world's axes, shape (..., n, 3, 3), kg m^2.
        angular_velocities: Shape (..., n, 3), rad/s.
    """
    m, total, p, com = _masses(masses, positions)
    v, spin = finite_arrays(velocities=velocities, angular_velocities=angular_velocities)
    inertia = _inertias(inertias)
    linear = np.einsum("...n,...ni->...i", m, v)
    # Relative to the centre of mass; the bodies' velocities need no such shift, since sum m (p - c) = 0.
    orbital = np.cross(p - com[..., None, :], m[..., None] * v).sum(axis=-2)
    angular = orbital + np.einsum("...nij,...nj->...i", inertia, spin)
    return CentroidalMomentum(total, com, linear / total[..., None], linear, angular)


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
    m, _, p, com = _masses(masses, positions)
    jac, turn = finite_arrays(linear_jacobians=linear_jacobians, angular_jacobians=angular_jacobians)
    inertia = _inertias(inertias)
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
    m, _, p, com = _masses(masses, positions)
    linear, turn, spin = finite_arrays(
        linear_drifts=linear_drifts, angular_drifts=angular_drifts, angular_velocities=angular_velocities
    )
    inertia = _inertias(inertias)
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
    (m,) = finite_arrays(mass=mass)
    angular = (np.cross(p - c[..., None, :], f) + t).sum(axis=-2)
    return f.sum(axis=-2) + m[..., None] * g, angular


def _masses(masses: ArrayLike, positions: ArrayLike) -> tuple[Array, Array, Array, Array]:
    """Masses (..., n), their sum (...), positions (..., n, 3), centre of mass (..., 3)."""
    (m,), (p,) = finite_arrays(masses=masses), finite_arrays(positions=positions)
    if m.ndim == 0 or p.ndim < 2 or p.shape[-1] != 3 or p.shape[-2] != m.shape[-1]:
        raise ConfigurationError(
            f"expected masses (..., n) and positions (..., n, 3), got {m.shape} and {p.shape}"
        )
    total = m.sum(axis=-1)
    if not ((m >= 0.0).all() and (total > 0.0).all()):
        raise ConfigurationError(f"masses must be 0 or more and not all 0, got {m}")
    return m, total, p, np.einsum("...n,...ni->...i", m, p) / total[..., None]


def _inertias(inertias: ArrayLike) -> Array:
    (inertia,) = finite_arrays(inertias=inertias)
    if inertia.ndim < 3 or inertia.shape[-2:] != (3, 3):
        raise ConfigurationError(f"inertias must have shape (..., n, 3, 3), got {inertia.shape}")
    return inertia
