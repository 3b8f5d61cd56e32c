"""Centroidal momentum: linear and angular momentum of a robot about its centre of mass.

Source: appendix "Centroidal momentum dynamics". Vectors are in the world's axes; the angular momentum is about the
moving centre of mass.
"""

from typing import NamedTuple

import numpy as np

from safe_wrappers.checks import Array


class CentroidalMomentum(NamedTuple):
    """Momentum: `linear`, kg m/s, and `angular` about the centre of mass, kg m^2/s, shape (3,) each."""

    mass: float  # kg
    com: Array  # centre of mass, shape (3,), m
    linear: Array
    angular: Array


def centroidal_momentum(
    masses: Array, positions: Array, velocities: Array, angular_momenta: Array
) -> CentroidalMomentum:
    """Of n parts together.

    Args:
        masses: Shape (n,), kg, their sum positive.
        positions: Of the parts' own centres of mass, shape (n, 3), m.
        velocities: Of the same points, shape (n, 3), m/s.
        angular_momenta: Of the parts about them, shape (n, 3), kg m^2/s.
    """
    total = float(masses.sum())
    com, momenta = masses @ positions / total, masses[:, None] * velocities
    # Relative to the centre of mass; the velocities need no such shift, since sum m (p - c) = 0.
    angular = (np.cross(positions - com, momenta) + angular_momenta).sum(axis=0)
    return CentroidalMomentum(total, com, momenta.sum(axis=0), angular)
