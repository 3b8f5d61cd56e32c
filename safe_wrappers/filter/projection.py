"""The minimal intervention: the control closest to the nominal one inside every half-space and the box.

Source: appendix "Minimal-intervention quadratic program" and Systems Perspective 1.1.

`rows_and_box` answers: the nominal is feasible (returned bit for bit), or the compiled active set, whose answer is
checked. Named solvers see problems of several rows only, and their answers are checked, too. Calls share no state.
"""

import math
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError, UnknownNameError
from safe_wrappers.filter import rows_and_box
from safe_wrappers.filter.problem import Projection, Status
from safe_wrappers.filter.qp import OPTIMALITY_TOLERANCE, control_unit, nearest, plain, solve_with_daqp
from safe_wrappers.filter.rows_and_box import LARGEST, OVERFLOWING, keep_rows, row_slacks

OWN = "active-set"
"""The solver that is compiled with the library."""
STATUSES = (Status.INACTIVE, Status.PROJECTED, Status.INFEASIBLE, Status.FAILED)


def project(
    u_nom: ArrayLike,
    normals: ArrayLike,
    offsets: ArrayLike,
    lower: ArrayLike,
    upper: ArrayLike,
    solver: str = OWN,
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
        solver: "active-set" (compiled, exact to round-off), "daqp" (called directly) or any installed qpsolvers
            backend by name. Where a named one has no answer that passes the check, the active set answers.

    Raises:
        ConfigurationError: Shapes do not match, bounds cross, or an argument that must be finite is not.
        UnknownNameError: No such solver is installed.
    """
    if solver != OWN:
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
        if lo.shape != u.shape:
            lo = np.full(m, lo)
        if hi.shape != u.shape:
            hi = np.full(m, hi)
    except ValueError:
        raise ConfigurationError(f"expected bounds of shape ({m},); got {lo.shape} and {hi.shape}") from None
    return project_unchecked(u, a, b, lo, hi, solver)


def check_solver(solver: str) -> None:
    """Refuse a solver that is not installed, naming those that are."""
    if solver in (OWN, "daqp"):
        return
    import qpsolvers  # here: it imports every solver that is installed, JAX and torch among them

    if solver not in qpsolvers.available_solvers:
        there = ", ".join(sorted(qpsolvers.available_solvers))
        raise UnknownNameError(f"solver {solver!r} is not installed; installed: {OWN}, {there}")


def project_unchecked(u: Array, a: Array, b: Array, lo: Array, hi: Array, solver: str) -> Projection:
    """`project` for callers that have already checked types and shapes.

    Raises:
        ConfigurationError: A nominal that is not finite, or bounds that cross.
    """
    control, multipliers = np.empty(u.size), np.empty(b.size)
    problem = plain(u, a, b, lo, hi)
    ended, violation, steps = keep_rows(*problem, solver != OWN, control, multipliers)
    if ended == rows_and_box.INACTIVE:
        return Projection(u, Status.INACTIVE, 0.0, multipliers, 0)
    if ended <= rows_and_box.INFEASIBLE:
        return Projection(control, STATUSES[ended], violation, multipliers, steps)
    if ended == rows_and_box.UNUSUAL:
        return _finite_rows_only(u, a, b, lo, hi, solver)
    if ended == rows_and_box.BAD_NOMINAL:
        raise ConfigurationError(f"u_nom must be finite, got {u}; replace it before projecting")
    if ended == rows_and_box.BAD_BOX:
        raise ConfigurationError(f"lower must not exceed upper, got {lo} and {hi}")
    answer = nearest("daqp" if solver == OWN else solver, u, a, b, lo, hi)
    if answer is not None:
        violation = max(0.0, float((a @ answer[0] - b).max()))
        return Projection(answer[0], Status.PROJECTED, violation, *answer[1:])
    if solver != OWN:  # its failure does not make the problem infeasible
        return project_unchecked(u, a, b, lo, hi, OWN)
    return Projection(control, Status.FAILED, max(0.0, float((a @ control - b).max())), multipliers, steps)


def _finite_rows_only(u: Array, a: Array, b: Array, lo: Array, hi: Array, solver: str) -> Projection:
    """Rows with numbers that are not finite or too large cannot be checked: respect the others, say failed."""
    fine = (np.abs(a) < LARGEST).all(axis=1) & (b > -OVERFLOWING)
    control = np.clip(u, lo, hi)
    if bool((np.abs(u) < LARGEST).all() and (np.abs(control) < LARGEST).all()):
        control = project_unchecked(u, a[fine], b[fine], lo, hi, solver).control
    return Projection(control, Status.FAILED, math.inf, np.zeros(b.size), 0)


@cache
def load_compiled() -> None:
    """Load the compiled projection, or compile it (10 to 15 s, once per machine), so that no control step waits."""
    one = np.ones(1)
    row = one.reshape(1, 1), -0.5 * one, -one, one
    project_unchecked(one, *row, OWN)
    keeps_rows(one, *row)


def keeps_rows(control: Array, normals: Array, offsets: Array, lower: Array, upper: Array) -> bool:
    """Whether a control satisfies every row as closely as `project` asks of its answers."""
    return row_slacks(*plain(control, normals, offsets, lower, upper))[0]


def box_least_squares(a: Array, b: Array, lower: Array, upper: Array) -> Array:
    """The x in the box that minimises `|a x - b|^2`, shape (n,); `a` has full column rank."""
    hessian, linear = a.T @ a, -(a.T @ b)
    best = np.asarray(np.linalg.solve(hessian, -linear), dtype=np.float64)
    unit = control_unit(best, lower, upper, 0.0)
    no_rows = np.zeros((0, linear.size)), np.zeros(0)
    answer = solve_with_daqp(hessian, linear / unit, *no_rows, lower / unit, upper / unit)
    if answer is not None:
        found = np.clip(answer[0] * unit, lower, upper)
        downhill = np.clip(found - (hessian @ found + linear) / np.diag(hessian), lower, upper)
        if bool((np.abs(downhill - found) <= OPTIMALITY_TOLERANCE * unit).all()):
            return np.asarray(found)
    # Without rows the problem cannot be infeasible; on a numerical failure the unbounded answer, clipped.
    return np.asarray(np.clip(best, lower, upper))


def cast_inside(control: Array, dtype: Any, normals: Array, offsets: Array, low: Array, high: Array) -> Any:
    """A control inside its rows and a box that is exact in `dtype`, cast to it; finite where the box is not.

    Where rounding broke a row, each component moves by one unit in the last place towards feasibility.
    """
    most = np.finfo(dtype).max
    sent = np.clip(control, np.maximum(low, -most), np.minimum(high, most)).astype(dtype)
    if not offsets.size or dtype == np.float64:
        return sent
    excess = normals @ sent.astype(np.float64) - np.maximum(offsets, normals @ control)
    worst = int(excess.argmax())
    if excess[worst] <= 0.0:
        return sent
    towards = np.where(normals[worst] > 0.0, -np.inf, np.where(normals[worst] < 0.0, np.inf, sent))
    return np.clip(np.nextafter(sent, towards.astype(dtype)), low.astype(dtype), high.astype(dtype))
