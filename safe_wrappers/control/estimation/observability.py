"""Observability: which directions of a state outputs determine, named in the user's own state names.

An initial error in an unobservable direction never shows in the outputs, so no filter corrects it. Full rank says
that the state can be determined from ideal outputs, not how accurately or how soon. Of a linear system the Lie
derivatives of the outputs are C A^k x, so that this is their rank test, too.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, finite_array
from safe_wrappers.errors import ConfigurationError

TOLERANCE: Final = 1e-9
"""Singular values up to this share of the scale count as zero."""
_PIVOT: Final = 0.1
"""Share of the largest coefficient from which on one may be divided by."""


def unobservable_subspace(a: Array, c: Array, tolerance: float = TOLERANCE) -> Array:
    """Orthonormal basis of what outputs C x of x' = A x never show, shape (n, n - rank).

    The largest subspace in the kernel of C that A maps into itself, by orthogonal projections: no powers of A, whose
    fast modes would hide the slow ones.

    Args:
        a: A, shape (n, n), of a size of about 1.
        c: C, shape (m, n), likewise.
        tolerance: What is seen by no more than this counts as not seen.
    """
    basis, seen = np.eye(len(a)), c
    while basis.shape[1]:
        _, values, axes = np.linalg.svd(seen)
        rank = int((values > tolerance).sum())
        if rank == 0:
            break
        basis = basis @ axes[rank:].T
        moved = a @ basis
        seen = moved - basis @ (basis.T @ moved)
    return np.asarray(basis)


def unobservable_directions(A: ArrayLike, C: ArrayLike, names: Sequence[str]) -> tuple[str, ...]:
    """The states' combinations that no output C x of x' = A x shows, one for each unobservable direction.

    Args:
        A: Shape (n, n), 1/s.
        C: Shape (m, n); a row of zeros measures nothing.
        names: Of the n states, in comparable units.

    Raises:
        ConfigurationError: Other shapes, or numbers that are not finite.

    >>> # A position that is measured, and a bias on a velocity that is not:
    >>> unobservable_directions([[0, 1, 1], [0, 0, 0], [0, 0, 0]], [[1, 0, 0]], names=("x", "v", "bias"))
    ('v - bias',)
    """
    a, c = finite_array("A", A), finite_array("C", C)
    n = len(names)
    if a.shape != (n, n) or c.ndim != 2 or c.shape[1] != n:
        raise ConfigurationError(
            f"A has shape {n, n} and C (m, {n}) with {n} names, got {a.shape}, {c.shape}"
        )
    lengths = np.linalg.norm(c, axis=1, keepdims=True)
    scaled = a / (np.linalg.norm(a, 2) or 1.0), c / np.where(lengths > 0.0, lengths, 1.0)
    return tuple(_described(row, names) for row in _reduced(unobservable_subspace(*scaled).T))


def _reduced(rows: Array) -> Array:
    """The row-reduced basis of the space that independent rows span, shape (k, n), by its first states."""
    rows = rows.copy()
    pivots: list[int] = []
    for i in range(len(rows)):
        sizes = np.abs(rows[i:]).max(axis=0)
        pivot = int(np.argmax(sizes >= _PIVOT * sizes.max()))
        best = i + int(np.argmax(np.abs(rows[i:, pivot])))
        rows[[i, best]] = rows[[best, i]]
        rows[i] /= rows[i, pivot]
        others = np.arange(len(rows)) != i
        rows[others] -= rows[others, pivot][:, None] * rows[i]
        pivots.append(pivot)
    return rows[np.argsort(pivots)]


def _described(direction: Array, names: Sequence[str]) -> str:
    """A direction (n,) in state space as a sum: "x - 0.75 y"."""
    text = ""
    for name, coefficient in zip(names, direction, strict=True):
        if abs(coefficient) > 1e-8:
            size = f"{abs(coefficient):.3g}"
            sign = " - " if coefficient < 0.0 else " + " if text else ""
            text += sign + (name if size == "1" else f"{size} {name}")
    return text.strip()
