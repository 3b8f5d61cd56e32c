"""The minimal intervention: the control closest to the nominal one inside every half-space and the box.

Source: appendix "Minimal-intervention quadratic program" and Systems Perspective 1.1.

The ways through, cheapest first: the nominal is feasible (returned bit for bit, no solver); one row and a box
(exact); else a QP backend. Every answer is checked with our own residual. Calls share no state. Solvers know only
absolute tolerances; they get the problem divided by a power of two, which rounds nothing.
"""

import math
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.errors import ConfigurationError, UnknownNameError
from safe_wrappers.filter.problem import (
    EXACT_SHARE,
    FEASIBILITY_TOLERANCE,
    Array,
    Projection,
    Status,
    box_size,
    control_unit,
    residual_scales,
)
from safe_wrappers.filter.qp import Answer, identity, solve_unit_rows, solve_with_daqp
from safe_wrappers.filter.single_row import project_single_row

_SHORTEST = 1e-6  # rows shorter than this, or longer than its inverse, are looked at one by one
_OVERFLOWING = 1e300  # where a sum is not finite, numbers from here on are taken as infinite


def project(
    u_nom: ArrayLike,
    normals: ArrayLike,
    offsets: ArrayLike,
    lower: ArrayLike,
    upper: ArrayLike,
    solver: str = "daqp",
) -> Projection:
    """Project a nominal control onto `{u : normals @ u <= offsets, lower <= u <= upper}`.

    A nominal that misses a row by up to 1e-9 of what half of the box changes of it counts as admissible; an answer
    may miss it by ten times as much. Where the box is wide (more than 16 control units) or open, the numbers that the
    row compares take its place. An infeasible problem gives the least violation: the smallest sum of squared,
    normalised violations, and among those the control closest to `u_nom`.

    Args:
        u_nom: Nominal control, shape (m,), finite.
        normals: Row normals, shape (k, m); k may be 0. A zero normal with a non-negative offset is dropped, with a
            negative one it makes the problem infeasible.
        offsets: Shape (k,).
        lower: Box, shape (m,); -inf is no bound.
        upper: Box, shape (m,); +inf is no bound.
        solver: "daqp" (called directly) or any installed qpsolvers backend by name.

    Raises:
        ConfigurationError: Shapes do not match, bounds cross, or an argument that must be finite is not.
        UnknownNameError: No such solver is installed.
    """
    check_solver(solver)
    u = np.array(u_nom, dtype=np.float64, ndmin=1)
    m = u.size
    a = np.asarray(normals, dtype=np.float64)
    b = np.asarray(offsets, dtype=np.float64).reshape(-1)
    a = a.reshape(b.size, m) if a.ndim < 2 and a.size == b.size * m else a  # one row may come flat
    lo, hi = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    if u.ndim != 1 or a.shape != (b.size, m):
        wanted = "u_nom (m,), normals (k, m) and offsets (k,)"
        raise ConfigurationError(f"expected {wanted}; got {u.shape}, {a.shape} and {b.shape}")
    try:
        if lo.shape != u.shape or hi.shape != u.shape:
            lo, hi = np.broadcast_to(lo, (m,)), np.broadcast_to(hi, (m,))
    except ValueError:
        raise ConfigurationError(f"expected bounds of shape ({m},); got {lo.shape} and {hi.shape}") from None
    if not np.isfinite(u).all():
        raise ConfigurationError(f"u_nom must be finite, got {u}; replace it before projecting")
    if not (lo <= hi).all():  # also refuses NaN
        raise ConfigurationError(f"lower must not exceed upper, got {lo} and {hi}")
    return project_unchecked(u, a, b, lo, hi, solver)


def box_least_squares(a: Array, b: Array, lower: Array, upper: Array) -> Array:
    """The x in the box that minimises `|a x - b|^2`, shape (n,); `a` has full column rank."""
    hessian, linear = a.T @ a, -(a.T @ b)
    nearest = np.asarray(np.linalg.solve(hessian, -linear), dtype=np.float64)
    unit = control_unit(box_size(lower.tobytes(), upper.tobytes()), nearest, np.zeros(1), np.ones(1))
    no_rows = np.zeros((0, linear.size)), np.zeros(0)
    answer = solve_with_daqp(hessian, linear / unit, *no_rows, lower / unit, upper / unit)
    # Without rows the problem cannot be infeasible; on a numerical failure the unbounded answer, clipped.
    return np.asarray(np.clip(nearest if answer is None else answer[0] * unit, lower, upper))


def check_solver(solver: str) -> None:
    """Refuse a solver that is not installed, naming those that are."""
    if solver == "daqp":
        return
    import qpsolvers  # here: it imports every solver that is installed, JAX and torch among them

    if solver not in qpsolvers.available_solvers:
        there = ", ".join(sorted(qpsolvers.available_solvers))
        raise UnknownNameError(f"solver {solver!r} is not installed; installed: {there}")


def project_unchecked(u: Array, a: Array, b: Array, lo: Array, hi: Array, solver: str) -> Projection:
    """`project` for callers that have already checked types, shapes and finiteness of `u` and the box."""
    k = b.size
    if k == 1:
        return project_single_row(u, a, b, lo, hi)
    inside = bool(((u >= lo) & (u <= hi)).all())
    if k == 0:
        status = Status.INACTIVE if inside else Status.PROJECTED
        return Projection(u if inside else np.clip(u, lo, hi), status, 0.0, np.zeros(0), 0)
    length = np.sqrt(np.einsum("ij,ij->i", a, a))
    total = float((length + b).sum())
    if total - total != 0.0:  # a NaN or an infinity somewhere
        return _finite_rows_only(u, a, b, length, lo, hi, solver)
    excess = a @ u - b
    worst, longest = float(excess.max()), float(length.max())
    if inside and worst <= 0.0:
        return Projection(u, Status.INACTIVE, 0.0, np.zeros(k), 0)
    box = box_size(lo.tobytes(), hi.tobytes())
    slack = FEASIBILITY_TOLERANCE * residual_scales(u, a, b, length, box)
    # No row's slack is larger than the longest one's over the widest component.
    near = worst <= 2.0 * FEASIBILITY_TOLERANCE * box.widest * longest
    if inside and near and bool((excess <= slack).all()):
        return Projection(u, Status.INACTIVE, 0.0, np.zeros(k), 0)
    unit = 1.0 if box.ordinary else control_unit(box, u, excess, length)
    if solver == "daqp" and float(length.min()) * unit > _SHORTEST and longest * unit < 1.0 / _SHORTEST:
        answer = _daqp_in(unit, u, a, b, lo, hi)
        if answer is not None:
            control = np.minimum(np.maximum(answer[0], lo), hi)
            residual = a @ control - b
            if bool((residual <= EXACT_SHARE * slack).all()):
                violation = max(0.0, float(residual.max()))
                return Projection(control, Status.PROJECTED, violation, answer[1], answer[2])
    return _careful(u, a, b, lo, hi, length, slack, unit, solver)


def _daqp_in(unit: float, u: Array, a: Array, b: Array, lo: Array, hi: Array) -> Answer | None:
    """`solve_with_daqp` with the controls in another unit."""
    if unit == 1.0:
        return solve_with_daqp(identity(u.size), -u, a, b, lo, hi)
    answer = solve_with_daqp(identity(u.size), -u / unit, a * unit, b, lo / unit, hi / unit)
    return answer and (answer[0] * unit, answer[1] * (unit * unit), answer[2])


def keeps_rows(control: Array, normals: Array, offsets: Array, lower: Array, upper: Array) -> bool:
    """Whether a control satisfies every row as closely as `project` asks of its answers."""
    length = np.sqrt(np.einsum("ij,ij->i", normals, normals))
    size = residual_scales(control, normals, offsets, length, box_size(lower.tobytes(), upper.tobytes()))
    kept = normals @ control - offsets <= 10.0 * FEASIBILITY_TOLERANCE * size
    return bool((kept & np.isfinite(length)).all())  # what overflows would be allowed anything


def cast_inside(control: Array, dtype: Any, normals: Array, offsets: Array, low: Array, high: Array) -> Any:
    """A control inside its rows and a box that is exact in `dtype`, cast to it.

    Where rounding broke a row, each component moves by one unit in the last place towards feasibility.
    """
    sent = np.clip(control, low, high).astype(dtype)
    if not offsets.size or dtype == np.float64:
        return sent
    excess = normals @ sent.astype(np.float64) - np.maximum(offsets, normals @ control)
    worst = int(excess.argmax())
    if excess[worst] <= 0.0:
        return sent
    towards = np.where(normals[worst] > 0.0, -np.inf, np.where(normals[worst] < 0.0, np.inf, sent))
    return np.clip(np.nextafter(sent, towards.astype(dtype)), low.astype(dtype), high.astype(dtype))


def _careful(
    u: Array, a: Array, b: Array, lo: Array, hi: Array, length: Array, slack: Array, unit: float, solver: str
) -> Projection:
    """Row by row: which matter, which are degenerate, which cannot be met; then a backend on unit rows."""
    # What the box alone can reach decides which rows matter; a zero normal is the extreme case.
    highest, lowest = _extreme(a, lo, hi), -_extreme(-a, lo, hi)
    hopeless = bool((lowest > b + slack).any())
    keep = np.flatnonzero((highest > b) & (length > 0.0))
    rows, limits = a[keep], b[keep]
    if keep.size == 0:
        control, weights, iterations, solved = np.clip(u, lo, hi), np.zeros(0), 0, True
    elif keep.size == 1:
        one = project_single_row(u, rows, limits, lo, hi)
        control, weights, iterations, solved = one.control, one.multipliers, 0, one.status != Status.FAILED
    else:
        norm = length[keep]
        g, h = rows / norm[:, None], limits / norm / unit
        allowed = 10.0 * slack[keep] / norm / unit
        scaled = u / unit, g, h, lo / unit, hi / unit, allowed
        control, weights, iterations, solved = solve_unit_rows(*scaled, solver, hopeless)
        control, weights = np.clip(control * unit, lo, hi), weights * unit / norm
    residual = a @ control - b
    feasible = bool((residual <= slack * 10.0).all())
    violation = max(0.0, float(residual.max()))
    if feasible and solved:
        multipliers = np.zeros(b.size)
        multipliers[keep] = weights
        return Projection(control, Status.PROJECTED, violation, multipliers, iterations)
    status = Status.FAILED if (feasible or not solved) else Status.INFEASIBLE
    return Projection(control, status, violation, np.zeros(b.size), iterations)


def _finite_rows_only(
    u: Array, a: Array, b: Array, length: Array, lo: Array, hi: Array, solver: str
) -> Projection:
    """A row whose length or offset is not finite, or too large, cannot be checked: respect the others, say failed."""
    # An offset of +inf asks for nothing; everything else that is not finite is a failed constraint.
    harmless = (length < _OVERFLOWING) & (b >= _OVERFLOWING)
    fine = (length < _OVERFLOWING) & (np.abs(b) < _OVERFLOWING)
    part = project_unchecked(u, a[fine], b[fine], lo, hi, solver)
    status = part.status if bool((harmless | fine).all()) else Status.FAILED
    multipliers = np.zeros(b.size)
    multipliers[fine] = part.multipliers
    violation = part.violation if status is not Status.FAILED else math.inf
    return Projection(part.control, status, violation, multipliers, part.iterations)


def _extreme(a: Array, lo: Array, hi: Array) -> Array:
    """The largest `a @ u` over the box, per row; a zero entry ignores its (possibly infinite) bound."""
    with np.errstate(invalid="ignore"):
        terms = np.where(a > 0.0, a * hi, np.where(a < 0.0, a * lo, 0.0))
    return cast(Array, terms.sum(axis=1))
