"""Several rows and a box by a QP backend: nearest control, least violation, and the checks of a backend's answer.

Solvers know only absolute tolerances: callers give them rows of order one and controls of order one.
"""

import functools
import math
import warnings
from collections.abc import Callable
from typing import cast

import daqp
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.filter.problem import EXACT_SHARE, UNBOUNDED, Array

_OPTIMALITY_TOLERANCE = 1e-4  # between a backend's answer and the one of its multipliers, in `control_unit`s
_SOLVERS_TOLERANCE = 1e-11  # of daqp, in `control_unit`s: rows at a small angle multiply a residual
_SOFT = 1e-8  # weight of the distance from the nominal beside squared violations
Answer = tuple[Array, Array, int]
"""x, row multipliers, iterations."""
Backend = Callable[[Array, Array, Array, Array, Array, Array], Answer | None]
"""(P, q, G, h, lower, upper) -> an answer, or None when it gave up."""


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


def solve_unit_rows(
    u: Array, g: Array, h: Array, lo: Array, hi: Array, allowed: Array, solver: str, hopeless: bool
) -> tuple[Array, Array, int, bool]:
    """Several unit rows and a box by a QP backend; least violation where they contradict each other."""
    backend = solve_with_daqp if solver == "daqp" else _named(solver)
    if not hopeless:
        answer = _nearest(backend, u, g, h, lo, hi, allowed)
        if answer is None and solver != "daqp":  # its failure does not make the problem infeasible
            answer = _nearest(solve_with_daqp, u, g, h, lo, hi, allowed)
        if answer is not None:
            exact = bool((g @ answer[0] - h <= 0.1 * EXACT_SHARE * allowed).all())
            return *(answer if exact else _by_distance(u, g, h, lo, hi, allowed) or answer), True
    least = _least_violation(backend, u, g, h, lo, hi)
    if least is None and solver != "daqp":
        least = _least_violation(solve_with_daqp, u, g, h, lo, hi)
    # If some control keeps the rows, the least violation is at most what the soft weight makes of its distance.
    thin = 2.0 * math.sqrt(_SOFT) * float(np.linalg.norm(hi - lo))
    if not hopeless and (least is None or float((g @ least - h).max()) <= thin):
        answer = _by_distance(u, g, h, lo, hi, allowed)
        if answer is not None:
            return *answer, True
    if least is None:
        return np.clip(u, lo, hi), np.zeros(h.size), 0, False
    # Closest to the nominal among those that violate (about) as little.
    relaxed = np.maximum(h, g @ least) + 0.1 * allowed
    answer = _nearest(solve_with_daqp, u, g, relaxed, lo, hi, allowed)
    return *(answer or (least, np.zeros(h.size), 0)), True


def _nearest(
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
    if float(np.abs(np.clip(u - multipliers @ g, lo, hi) - x).max()) > _OPTIMALITY_TOLERANCE:
        return None
    return x, multipliers, iterations


def _by_distance(u: Array, g: Array, h: Array, lo: Array, hi: Array, allowed: Array) -> Answer | None:
    """The projection by non-negative least squares (Lawson and Hanson, Solving Least Squares Problems, ch. 23).

    Where rows oppose each other at a small angle, a small residual can be far from every admissible control. The
    residual of these least squares is `1 / sqrt(1 + distance^2)`: whether a control exists is decided by how far away
    it is.
    """
    from scipy.optimize import nnls  # here: few need it, and it takes a while to import

    above, below = np.flatnonzero(np.isfinite(hi)), np.flatnonzero(np.isfinite(lo))
    rows = np.vstack([g, identity(u.size)[above], -identity(u.size)[below]])
    room = np.concatenate([h - g @ u, hi[above] - u[above], u[below] - lo[below]])
    system = -np.vstack([rows.T, room])
    aim = np.append(np.zeros(u.size), 1.0)
    try:
        weights, _ = nnls(system, aim)
    except RuntimeError:  # too many iterations
        return None
    left = aim - system @ weights
    if not left[-1] > 0.0:
        return None
    x = np.clip(u - left[:-1] / left[-1], lo, hi)
    multipliers = weights[: h.size] / left[-1]
    polished = _polish(u, g, h, lo, hi, allowed, x, multipliers)
    x = x if polished is None else polished
    return (x, multipliers, 0) if bool((g @ x - h <= allowed).all()) else None


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
    fixed[free] = 0.0
    part = g[np.ix_(active, free)]
    need = h[active] - g[active][:, ~free] @ fixed[~free] - part @ u[free]
    step = np.linalg.lstsq(part, need, rcond=None)[0]
    polished = fixed.copy()
    polished[free] = u[free] + step
    inside = bool((polished >= lo).all() and (polished <= hi).all())
    return polished if inside and not bool((g @ polished - h > allowed).any()) else None


def _least_violation(backend: Backend, u: Array, g: Array, h: Array, lo: Array, hi: Array) -> Array | None:
    """Minimise the squared violations of unit rows over the box; the box itself is never softened."""
    m, k = u.size, h.size
    weight = np.diag(np.concatenate([np.full(m, _SOFT), np.ones(k)]))
    linear = np.concatenate([-_SOFT * u, np.zeros(k)])
    rows = np.hstack([g, -np.eye(k)])
    low, high = np.concatenate([lo, np.zeros(k)]), np.concatenate([hi, np.full(k, np.inf)])
    answer = backend(weight, linear, rows, h, low, high)
    if answer is None or not np.isfinite(answer[0]).all():
        return None
    return cast(Array, np.clip(answer[0][:m], lo, hi))
