"""Observability: which directions of a state outputs determine, named in the user's own state names.

An initial error in an unobservable direction never shows in the outputs, so no filter corrects it. Full rank says
that the state can be determined from ideal outputs, not how accurately or how soon.
"""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, finite_array
from safe_wrappers.errors import ConfigurationError

TOLERANCE: Final = 1e-9
"""Default: singular values below this share of the scale count as zero."""

LONGEST_TIME_SCALE_S: Final = 1e6
"""s; bound on the time scale, so that rounding errors do not count as slow motion."""

_NO_COUPLING = 1e-13
"""Entries of A or C below this share of the largest count as rounding."""
_NEGLIGIBLE = 1e-8
_PIVOT = 0.1


class Scaled(NamedTuple):
    """A dimensionless system: states in `units`, rows of C of length one."""

    a: Array
    c: Array
    units: Array


def unobservable_directions(
    A: ArrayLike, C: ArrayLike, names: Sequence[str] | None = None
) -> tuple[str, ...]:
    """The states' combinations that no output C x of x' = A x shows, one for each unobservable direction.

    Args:
        A: Shape (n, n), 1/s.
        C: Shape (m, n); a row of zeros measures nothing.
        names: Of the n states; x0, x1, ... if not given.

    Raises:
        ConfigurationError: Other shapes, numbers that are not finite, or names that are not one for each state.

    >>> # A position that is measured, and a bias on a velocity that is not:
    >>> unobservable_directions([[0, 1, 1], [0, 0, 0], [0, 0, 0]], [[1, 0, 0]], names=("x", "v", "bias"))
    ('v - bias',)
    """
    a, c = checked_system(A, C)
    basis = unobservable_subspace(scale_system(a, c), TOLERANCE)
    return described_subspace(basis, state_names(names, len(a)))


def unobservable_subspace(scaled: Scaled, tolerance: float) -> Array:
    """Orthonormal basis of the unobservable directions in the states' own units, shape (n, n - rank).

    The largest subspace in the kernel of C that A maps into itself, by orthogonal projections.
    """
    basis, seen = np.eye(len(scaled.a)), scaled.c
    while basis.shape[1]:
        _, values, axes = np.linalg.svd(seen @ basis if seen is scaled.c else seen)
        rank = int((values > tolerance).sum())
        if rank == 0:
            break
        basis = basis @ axes[rank:].T
        moved = scaled.a @ basis
        seen = moved - basis @ (basis.T @ moved)
    return np.asarray(np.linalg.qr(scaled.units[:, None] * basis)[0])


def described(direction: ArrayLike, names: Sequence[str]) -> str:
    """A direction (n,) in state space as a readable combination of the n states: "p_x - p_y", "0.8 x + 0.6 y".

    Coefficients of equal size are left out, and those below 1e-8 of the largest; the first one is positive.

    Raises:
        ConfigurationError: Names that are not one for each state, a direction that is zero or not finite.
    """
    vector = checked_vector(direction)
    known = state_names(names, len(vector))
    sizes = np.abs(vector)
    if not sizes.any():
        raise ConfigurationError("zero is no direction")
    shown = np.flatnonzero(sizes > _NEGLIGIBLE * sizes.max())
    if sizes[shown].min() > (1.0 - _NEGLIGIBLE) * sizes.max():
        vector = vector / sizes.max()
    text = ""
    for i in shown:
        coefficient = vector[i] * math.copysign(1.0, vector[shown[0]])
        size = f"{abs(coefficient):.3g}"
        sign = " - " if coefficient < 0.0 else " + "
        text += (sign if text else "") + (known[i] if size == "1" else f"{size} {known[i]}")
    return text


def described_subspace(basis: Array, names: Sequence[str]) -> tuple[str, ...]:
    """A readable, row-reduced basis of the subspace that independent columns, shape (n, k), span."""
    rows = basis.T.copy()
    pivots: list[int] = []
    for i in range(len(rows)):
        sizes = np.abs(rows[i:]).max(axis=0)
        # The first state with a coefficient that is not small; small pivots would give large coefficients.
        pivot = int(np.argmax(sizes >= _PIVOT * sizes.max()))
        best = i + int(np.argmax(np.abs(rows[i:, pivot])))
        rows[[i, best]] = rows[[best, i]]
        rows[i] /= rows[i, pivot]
        others = np.arange(len(rows)) != i
        rows[others] -= rows[others, pivot][:, None] * rows[i]
        pivots.append(pivot)
    return tuple(described(rows[i], names) for i in np.argsort(pivots))


def scale_system(a: Array, c: Array) -> Scaled:
    """The system without units, states scaled so that their couplings are about equally strong."""
    units = _units(a, c)
    a = a * units / units[:, None]
    c = c * units
    rate = max(float(np.linalg.norm(a, 2)), 1.0 / LONGEST_TIME_SCALE_S)
    lengths = np.linalg.norm(c, axis=1, keepdims=True)
    return Scaled(a / rate, c / np.where(lengths > 0.0, lengths, 1.0), units)


def _units(a: Array, c: Array) -> Array:
    """Units of the states, shape (n,), powers of two, in which all couplings between states are about equal.

    Least squares of the entries' logarithms (Curtis and Reid, 1972), with a time scale and the outputs' gains free.
    """
    n, m = len(a), len(c)
    couplings = _logarithms(a - np.diag(np.diag(a)), np.abs(a).max())
    gains = _logarithms(c, np.abs(c).max())
    entries = [(j, [i, n], log) for (i, j), log in couplings]
    entries += [(j, [n + 1 + k], log) for (k, j), log in gains]
    if not entries:
        return np.ones(n)
    rows, right = np.zeros((len(entries), n + 1 + m)), [-log for _, _, log in entries]
    for row, (state, others, _) in zip(rows, entries, strict=True):
        row[state], row[others] = 1.0, -1.0
    solution = np.linalg.lstsq(rows, np.array(right), rcond=None)[0]
    return np.asarray(np.exp2(np.round(solution[:n])))


def _logarithms(matrix: Array, largest: float) -> list[tuple[tuple[int, int], float]]:
    """Places and binary logarithms of the entries that are above rounding."""
    sizes = np.abs(matrix)
    places = np.argwhere(sizes > _NO_COUPLING * largest)
    return [((int(i), int(j)), float(np.log2(sizes[i, j]))) for i, j in places]


def checked_system(A: ArrayLike, C: ArrayLike) -> tuple[Array, Array]:
    """A (n, n) and C (m, n) as float64."""
    a, c = finite_array("A", A), finite_array("C", C)
    if a.ndim != 2 or a.shape[0] != a.shape[1] or a.size == 0:
        raise ConfigurationError(f"A must be square, of shape (n, n), got {a.shape}")
    if c.ndim != 2 or c.shape[1] != len(a) or len(c) == 0:
        raise ConfigurationError(f"C: a row for each output, shape (m, {len(a)}) for this A, got {c.shape}")
    return a, c


def checked_vector(x: ArrayLike) -> Array:
    """A finite vector as float64, shape (n,), n > 0."""
    vector = finite_array("x", x)
    if vector.ndim != 1 or vector.size == 0:
        raise ConfigurationError(f"expected a vector, of shape (n,), got shape {vector.shape}")
    return vector


def state_names(names: Sequence[str] | None, n: int) -> tuple[str, ...]:
    """The names of n states; x0, x1, ... for None."""
    if names is None:
        return tuple(f"x{i}" for i in range(n))
    if isinstance(names, str) or len(names) != n or len(set(names)) != n:
        raise ConfigurationError(f"expected a name of its own for each of the {n} states, got {names!r}")
    return tuple(names)
