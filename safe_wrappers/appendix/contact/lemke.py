"""Linear complementarity problems by Lemke's method.

Source: Lemke (1965), Bimatrix equilibrium points and mathematical programming; the form here after Cottle, Pang and
Stone (1992), The Linear Complementarity Problem, section 4.4. Find z with

    w = M z + q,    z >= 0,    w >= 0,    z . w = 0.

Complementary pivots from the basis w, with one artificial variable whose column is positive (the cover). Ties are
broken lexicographically, so no basis comes twice.

For dense problems of up to some tens of unknowns, as a control step's contacts are.
"""

from enum import Enum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.checks import Array, finite_array
from safe_wrappers.errors import ConfigurationError

_SMALL: Final = 1e-11
"""Share of the matrix's largest entry below which a pivot counts as zero."""
_RESIDUAL: Final = 1e-8
"""Share of the problem's own size by which an answer may miss the conditions."""
_PIVOTS: Final = 50
"""Pivots per unknown, far beyond what is seen in practice; in theory there may be 2^n."""


class LcpStatus(Enum):
    """How Lemke's method ended."""

    SOLVED = "solved"
    """The answer was checked against the conditions."""
    RAY = "ray"
    """It ended on a ray. For a positive semidefinite matrix there is no solution; else there may be one."""
    FAILED = "failed"
    """Too many pivots, or rounding spoilt the answer."""


class LcpSolution(NamedTuple):
    """What was found.

    Attributes:
        z: Shape (n,); zeros unless solved.
        w: `M z + q`, shape (n,).
        status: See `LcpStatus`.
        pivots: How many were made.
    """

    z: Array
    w: Array
    status: LcpStatus
    pivots: int


def solve_lcp(matrix: ArrayLike, vector: ArrayLike) -> LcpSolution:
    """Lemke's method on one problem.

    Args:
        matrix: M, shape (n, n), n >= 1.
        vector: q, shape (n,).

    Raises:
        ConfigurationError: Other shapes, or what is not finite.
    """
    m, q = finite_array("matrix", matrix), finite_array("vector", vector)
    n = len(q) if q.ndim == 1 else 0
    if n == 0 or m.shape != (n, n):
        raise ConfigurationError(
            f"expected a matrix of shape (n, n) and a vector of shape (n,), got {m.shape} and {q.shape}"
        )
    if (q >= 0.0).all():
        return LcpSolution(np.zeros(n), q.copy(), LcpStatus.SOLVED, 0)
    # In units of the largest entries, which changes neither the pivots nor their order.
    size, length = float(np.abs(m).max()) or 1.0, float(np.abs(q).max())
    # On degenerate problems rounding can lead one way onto a ray that is none: another cover is another way.
    for cover in (np.ones(n), 1.0 + np.arange(n) / n):
        status, basis, pivots = _pivots(m / size, q / length, cover)
        if status is LcpStatus.SOLVED:
            z = _basic_solution(m / size, q / length, basis) * (length / size)
            w = m @ z + q
            if _holds(m, q, z, w):
                return LcpSolution(z, w, status, pivots)
            status = LcpStatus.FAILED
    return LcpSolution(np.zeros(n), q.copy(), status, pivots)


def _pivots(m: Array, q: Array, cover: Array) -> tuple[LcpStatus, NDArray[np.int64], int]:
    """The way to a complementary basis. Variables: w are 0 to n - 1, z are n to 2n - 1, the artificial one is 2n."""
    n = len(q)
    artificial = 2 * n
    table = np.hstack([np.eye(n), -m, -cover[:, None], q[:, None]])
    basis = np.arange(n)
    leaving = _lexicographic_least(table[:, [-1, *range(n)]] / cover[:, None], np.arange(n))
    entering = artificial
    for pivots in range(1, _PIVOTS * n + 1):
        table[leaving] /= table[leaving, entering]
        rest = np.arange(n) != leaving
        table[rest] -= np.outer(table[rest, entering], table[leaving])
        left, basis[leaving] = int(basis[leaving]), entering
        if left == artificial:
            return LcpStatus.SOLVED, basis, pivots
        entering = left + n if left < n else left - n  # its complement
        column = table[:, entering]
        rows = np.flatnonzero(column > _SMALL)
        if not len(rows):
            if table[basis == artificial, -1] > _SMALL:
                return LcpStatus.RAY, basis, pivots
            basis[basis == artificial] = left  # it is zero: rounding hid that it could leave with this one
            return LcpStatus.SOLVED, basis, pivots
        ratios = table[rows][:, [-1, *range(n)]] / column[rows, None]
        # Where the artificial variable can leave, it does: that is the end.
        least = float(ratios[:, 0].min())
        first = np.flatnonzero(
            (basis[rows] == artificial) & (ratios[:, 0] <= least + _SMALL * max(1.0, least))
        )
        leaving = int(rows[first[0]]) if len(first) else _lexicographic_least(ratios, rows)
    return LcpStatus.FAILED, basis, _PIVOTS * n


def _lexicographic_least(keys: Array, rows: NDArray[np.int64]) -> int:
    """The row whose key comes first, compared entry by entry; what differs by rounding is equal."""
    left = np.arange(len(rows))
    for column in keys.T:
        values = column[left]
        left = left[values <= values.min() + _SMALL]
        if len(left) == 1:
            break
    return int(rows[left[0]])


def _basic_solution(m: Array, q: Array, basis: NDArray[np.int64]) -> Array:
    """Z of a complementary basis, from the data and not from the table, which has gathered rounding."""
    n = len(q)
    z = np.zeros(n)
    active = np.sort(basis[basis >= n]) - n
    if len(active):
        z[active] = np.linalg.lstsq(m[np.ix_(active, active)], -q[active], rcond=None)[0]
    return np.maximum(z, 0.0)


def _holds(m: Array, q: Array, z: Array, w: Array) -> bool:
    """Whether the conditions hold up to rounding, each row against the size of what was added up in it."""
    size = np.abs(m) @ z + np.abs(q).max()
    return bool(
        (w >= -_RESIDUAL * size).all() and (np.minimum(z * np.abs(m).max(), w) <= _RESIDUAL * size).all()
    )
