"""Observability of linear systems, with its numbers.

`safe_wrappers.control.estimation.observability` finds the unobservable directions alone, and
`safe_wrappers.control.estimation.lie_derivatives` those of nonlinear systems.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.checks import Array
from safe_wrappers.control.estimation.lie_derivatives import (
    Observability,
    checked_tolerance,
    padded,
    tolerance_gap,
)
from safe_wrappers.control.estimation.observability import (
    checked_system,
    described_subspace,
    scale_system,
    state_names,
    unobservable_subspace,
)


@dataclass(frozen=True, eq=False)
class LinearObservability(Observability):
    """Observability of x' = A x, y = C x, at every state and over any interval of time.

    Attributes:
        time_scale_s: Time by which A was multiplied to be free of units, s.
        unobservable_modes: Eigenvalues of A on the unobservable directions, 1/s, shape (n - rank,).
    """

    time_scale_s: float
    unobservable_modes: NDArray[np.complex128]

    @property
    def detectable(self) -> bool:
        """Whether unobservable errors decay by themselves."""
        return bool((self.unobservable_modes.real < 0.0).all())


def observability_matrix(A: ArrayLike, C: ArrayLike) -> Array:
    """C, C A, ..., C A^(n-1), stacked, shape (m n, n), not scaled; take the rank from `linear_observability`.

    Args:
        A: Shape (n, n), 1/s.
        C: Shape (m, n).
    """
    a, c = checked_system(A, C)
    blocks = [c]
    for _ in range(len(a) - 1):
        blocks.append(blocks[-1] @ a)
    return np.concatenate(blocks)


def linear_observability(
    A: ArrayLike, C: ArrayLike, names: Sequence[str] | None = None, tolerance: float | None = None
) -> LinearObservability:
    """Observability of x' = A x from the outputs C x.

    The unobservable subspace is the largest one in the kernel of C that A maps into itself, found by orthogonal
    projections after scaling states, outputs and time to be free of units.

    Args:
        A: Shape (n, n), 1/s.
        C: Shape (m, n); a row of zeros measures nothing.
        names: Of the n states; x0, x1, ... if not given.
        tolerance: Singular values up to this count as zero, in scaled units; `TOLERANCE` if not given.

    Raises:
        ConfigurationError: Other shapes, numbers that are not finite, or names that are not one for each state.

    >>> # A position that is measured, and a bias on a velocity that is not:
    >>> A = [[0, 1, 1], [0, 0, 0], [0, 0, 0]]
    >>> linear_observability(A, [[1, 0, 0]], names=("x", "v", "bias")).names
    ('v - bias',)
    """
    a, c = checked_system(A, C)
    known = state_names(names, len(a))
    scaled = scale_system(a, c)
    values = np.linalg.svd(observability_matrix(scaled.a, scaled.c), compute_uv=False)
    tolerance = checked_tolerance(tolerance)
    basis, compared = unobservable_subspace(scaled, tolerance)
    return LinearObservability(
        rank=len(a) - basis.shape[1],
        singular_values=padded(values, len(a)),
        gap=min((tolerance_gap(each, tolerance) for each in compared), default=math.inf),
        unobservable=basis,
        names=described_subspace(basis, known),
        time_scale_s=scaled.time_s,
        unobservable_modes=np.linalg.eigvals(basis.T @ a @ basis).astype(np.complex128),
    )
