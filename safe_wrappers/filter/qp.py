"""Several rows and a box by a named QP backend, and the checks of its answer.

Backends know only absolute tolerances: they get rows of length one, and controls of order one by a division by a
power of two, which rounds nothing.
"""

import functools
import math
import warnings
from collections.abc import Callable

import daqp
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array
from safe_wrappers.filter.problem import ORDINARY_BOX, UNBOUNDED, half_width, residual_scale
from safe_wrappers.filter.rows_and_box import row_slacks

OPTIMALITY_TOLERANCE = 1e-4  # between a backend's answer and the one of its multipliers, in `control_unit`s
_SOLVERS_TOLERANCE = 1e-11  # of daqp, in `control_unit`s: rows at a small angle multiply a residual
Answer = tuple[Array, Array, int]
"""x, row multipliers, iterations."""
Backend = Callable[[Array, Array, Array, Array, Array, Array], Answer | None]
"""(P, q, G, h, lower, upper) -> an answer, or None when it gave up."""


def control_unit(u: Array, lower: Array, upper: Array, away: float) -> float:
    """A power of two of the size of the controls in question; `away` is by how far the nearest of them is."""
    size = max(map(half_width, lower.tolist(), upper.tolist()), default=0.0)
    if size > ORDINARY_BOX:
        size = residual_scale(size, 1.0, max(float(np.abs(u).max()), away), size)
    return math.ldexp(0.5, math.frexp(size)[1]) if size > 0.0 else 1.0


def plain(u: Array, a: Array, b: Array, lo: Array, hi: Array) -> tuple[Array, Array, Array, Array, Array]:
    """The arrays, copied where compiled code would have to be compiled anew for them: strides, read-only memory."""
    u, a, b, lo, hi = (part if part.flags.carray else part.copy() for part in (u, a, b, lo, hi))
    return u, a, b, lo, hi


def nearest(solver: str, u: Array, a: Array, b: Array, lower: Array, upper: Array) -> Answer | None:
    """The closest control by a backend, in the units of the problem; None: it has none that passes the checks.

    Arguments as of `project`, rows and numbers of usual size.
    """
    backend = solve_with_daqp if solver == "daqp" else _named(solver)
    _, slacks, lengths = row_slacks(*plain(u, a, b, lower, upper))
    asking = np.flatnonzero(lengths)
    if bool((b < -10.0 * slacks)[lengths == 0.0].any()):
        return None
    norm = lengths[asking]
    unit = control_unit(u, lower, upper, float(((a @ u - b)[asking] / norm).max(initial=0.0)))
    g, h = a[asking] / norm[:, None], b[asking] / norm / unit
    scaled = u / unit, g, h, lower / unit, upper / unit
    answer = _checked(backend, *scaled, 10.0 * slacks[asking] / norm / unit)
    if answer is None:
        return None
    multipliers = np.zeros(b.size)
    multipliers[asking] = answer[1] * unit / norm
    return np.clip(answer[0] * unit, lower, upper), multipliers, answer[2]


def _checked(
    backend: Backend, u: Array, g: Array, h: Array, lo: Array, hi: Array, allowed: Array
) -> Answer | None:
    answer = backend(identity(u.size), -u, g, h, lo, hi)
    if answer is None:
        return None
    x, multipliers, iterations = answer
    x = np.clip(x, lo, hi)  # removes the backend's round-off at the box; the residual is checked after it
    if not np.isfinite(x).all() or bool((g @ x - h > allowed).any()):
        polished = _polish(u, g, h, lo, hi, allowed, x, multipliers)
        if polished is None:
            return None
        x = polished
    # Feasible is not yet closest: the multipliers must lead from the nominal to the answer.
    if not float(np.abs(np.clip(u - multipliers @ g, lo, hi) - x).max()) <= OPTIMALITY_TOLERANCE:
        return None
    return x, multipliers, iterations


def _polish(
    u: Array, g: Array, h: Array, lo: Array, hi: Array, allowed: Array, x: Array, multipliers: Array
) -> Array | None:
    """Solve the equalities of the active set that a first-order or interior-point backend has pointed to."""
    if not np.isfinite(x).all():
        return None
    active = multipliers > 1e-6 * max(1.0, float(multipliers.max(initial=0.0)))
    free = (x > lo + 1e-7) & (x < hi - 1e-7)
    if not active.any() or not free.any():
        return None
    fixed = np.where(free, 0.0, np.where(np.abs(x - lo) < np.abs(x - hi), lo, hi))
    part = g[np.ix_(active, free)]
    need = h[active] - g[active][:, ~free] @ fixed[~free] - part @ u[free]
    step = np.linalg.lstsq(part, need, rcond=None)[0]
    polished = fixed.copy()
    polished[free] = u[free] + step
    inside = bool((polished >= lo).all() and (polished <= hi).all())
    return polished if inside and not bool((g @ polished - h > allowed).any()) else None


@functools.cache
def identity(n: int) -> Array:
    """Shape (n, n); shared by all callers, not to be written to."""
    return np.eye(n)


@functools.cache
def _no_lower(k: int) -> Array:
    return np.full(k, -UNBOUNDED)


@functools.cache
def _sense(n: int) -> NDArray[np.int32]:
    return np.zeros(n, np.int32)


def solve_with_daqp(p: Array, q: Array, g: Array, h: Array, lo: Array, hi: Array) -> Answer | None:
    """The `Backend` that is called directly."""
    n, k = q.size, h.size
    upper = np.minimum(np.concatenate((hi, h)), UNBOUNDED)
    lower = np.maximum(np.concatenate((lo, _no_lower(k))), -UNBOUNDED)
    # daqp writes to the sense, so it gets a copy.
    x, _, flag, info = daqp.solve(
        p, q, np.ascontiguousarray(g), upper, lower, _sense(n + k).copy(), primal_tol=_SOLVERS_TOLERANCE
    )
    if flag < 1:
        return None
    return np.asarray(x), np.maximum(info["lam"][n:], 0.0), int(info["iterations"])


def _named(name: str) -> Backend:
    import qpsolvers

    def solve(p: Array, q: Array, g: Array, h: Array, lo: Array, hi: Array) -> Answer | None:
        problem = qpsolvers.Problem(p, q, g, h, lb=lo, ub=hi)
        try:
            with warnings.catch_warnings():  # of matrix conversions and of statuses, which we check ourselves
                warnings.simplefilter("ignore")
                solution = qpsolvers.solve_problem(problem, solver=name)
        except (qpsolvers.exceptions.QPError, ValueError, ArithmeticError):
            return None
        if not solution.found or solution.x is None:
            return None
        dual = solution.z if solution.z is not None else np.zeros(h.size)
        return np.asarray(solution.x), np.maximum(np.asarray(dual), 0.0), 0

    return solve
