"""Resonances of springs in a machine, and what share of a step's energy a gradual change of torque leaves in them.

A change s(t) of the torque from 0 to 1 excites a resonance w as a step does, times |integral of s'(t) exp(-i w t)|;
the energy that is left goes with the square, the **share**. The phase is w T, over the change's duration T.

Source: appendix "Flexible joint dynamics and singular perturbations".
"""

from typing import NamedTuple

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError


class Modes(NamedTuple):
    """Vibrations of a machine, the slowest first; rigid motions have a resonance of 0."""

    resonances: Array  # shape (n,), rad/s
    damping_ratios: Array  # shape (n,), to first order in the damping; 0 for rigid motions
    shapes: Array  # columns v with v . M v = 1, shape (n, n)


def modes(inertia: Array, stiffness: Array, damping: Array) -> Modes:
    """Vibrations of M x'' + D x' + K x = 0: a frame in which M is 1, and the eigenvectors of K there.

    Args:
        inertia: M, symmetric and positive definite, shape (n, n).
        stiffness: K, symmetric and positive semidefinite, shape (n, n).
        damping: D, shape (n, n).
    """
    root = np.linalg.inv(np.linalg.cholesky(inertia))
    squares, turned = np.linalg.eigh(root @ stiffness @ root.T)
    rigid = squares <= 1e-9 * squares.max(initial=0.0)
    omega = np.sqrt(np.where(rigid, 0.0, squares))
    shapes = root.T @ turned
    own = np.einsum("ji,jk,ki->i", shapes, damping, shapes)
    ratios = np.divide(own, 2.0 * omega, out=np.zeros_like(own), where=~rigid)
    return Modes(omega, ratios, shapes)


def shortest_smoothstep(share: float, resonance: float) -> float:
    """Duration, s, from which on a smoothstep leaves at most a share in a resonance (rad/s) and any faster one.

    The integral of s = 10 x^3 - 15 x^4 + 6 x^5, x = t / T, is 15 j2(k) / k^2, k = w T / 2, with the spherical Bessel
    function j2, which stays below sqrt(1 + 3/k^2 + 9/k^4) / k.
    """
    if not 0.0 < share < 1.0:
        raise ConfigurationError(f"a share of a step's energy is above 0 and below 1, got {share!r}")
    # The bound falls all along: as a polynomial in k^2, at this share, it has one positive root.
    squares = np.roots([share, 0.0, 0.0, -225.0, -675.0, -2025.0])
    return float(2.0 * np.sqrt(squares.real[squares.imag == 0.0].max()) / resonance)
