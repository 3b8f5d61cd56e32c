"""Resonances of springs in a machine.

Source: appendix "Flexible joint dynamics and singular perturbations".
"""

from typing import NamedTuple

import numpy as np

from safe_wrappers.checks import Array


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
