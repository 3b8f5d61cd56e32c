"""Centroidal momentum: linear and angular momentum of a robot about its centre of mass.

Source: appendix "Centroidal momentum dynamics". Vectors are in the world's axes; the angular momentum is about the
moving centre of mass; where both are stacked, the linear part comes first.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, finite_array, finite_arrays
from safe_wrappers.errors import ConfigurationError


class CentroidalMomentum(NamedTuple):
    """Momentum of several bodies: mass (...), kg; centre of mass (..., 3), m.

    `linear`, kg m/s, and `angular` about the centre of mass, kg m^2/s, have shape (..., 3).
    """

    mass: Array
    com: Array
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
    m, total, p, com = checked_masses(masses, positions)
    v, spin = finite_arrays(velocities=velocities, angular_velocities=angular_velocities)
    inertia = checked_inertias(inertias)
    linear = np.einsum("...n,...ni->...i", m, v)
    # Relative to the centre of mass; the bodies' velocities need no such shift, since sum m (p - c) = 0.
    orbital = np.cross(p - com[..., None, :], m[..., None] * v).sum(axis=-2)
    angular = orbital + np.einsum("...nij,...nj->...i", inertia, spin)
    return CentroidalMomentum(total, com, linear, angular)


def checked_masses(masses: ArrayLike, positions: ArrayLike) -> tuple[Array, Array, Array, Array]:
    """Masses (..., n), at least 0, their positive sum (...), positions (..., n, 3), centre of mass (..., 3)."""
    m, p = finite_array("masses", masses), finite_array("positions", positions)
    if m.ndim == 0 or p.ndim < 2 or p.shape[-1] != 3 or p.shape[-2] != m.shape[-1]:
        raise ConfigurationError(f"expected masses (..., n), positions (..., n, 3), got {m.shape}, {p.shape}")
    total = m.sum(axis=-1)
    if not ((m >= 0.0).all() and (total > 0.0).all()):
        raise ConfigurationError(f"masses must be 0 or more and not all 0, got {m}")
    return m, total, p, np.einsum("...n,...ni->...i", m, p) / total[..., None]


def checked_inertias(inertias: ArrayLike) -> Array:
    """Inertias as float64, shape (..., n, 3, 3)."""
    inertia = finite_array("inertias", inertias)
    if inertia.ndim < 3 or inertia.shape[-2:] != (3, 3):
        raise ConfigurationError(f"inertias must have shape (..., n, 3, 3), got {inertia.shape}")
    return inertia
