"""Many projections at once: what needs no solver in arrays over the batch, the rest one by one.

Two kinds of problem need no solver. The nominal keeps every row; or the projection on the box and the row that is
violated most keeps every other row, and is then the projection on all of them.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.problem import (
    EXACT_SHARE,
    FEASIBILITY_TOLERANCE,
    Array,
    Status,
    batch_residual_scales,
)
from safe_wrappers.filter.projection import check_solver, project_unchecked

Mask = NDArray[np.bool_]

_CLEAR = 1e-6  # share of a tolerance by which a residual must differ from it to be judged here
_FEW = 16  # fewer problems that a nominal does not solve are faster one by one
_SPARE = 1e3  # tolerances by which all other rows must be kept where the projection on one row is the answer
_LARGEST = 1e150  # larger numbers may overflow when squared: left to `project`


class BatchProjection(NamedTuple):
    """The answers to B problems, each as in `Projection`.

    Attributes:
        controls: Shape (B, m), always finite and inside the box.
        status: The strings of `Status`, shape (B,).
        violation: Largest `normals @ control - offsets` of each problem, at least 0, shape (B,), row units.
        multipliers: One per row, shape (B, k), at least 0; zeros unless `projected`.
    """

    controls: Array
    status: NDArray[np.str_]
    violation: Array
    multipliers: Array


def project_batch(
    u_nom: ArrayLike,
    normals: ArrayLike,
    offsets: ArrayLike,
    lower: ArrayLike,
    upper: ArrayLike,
    solver: str = "daqp",
) -> BatchProjection:
    """Project B nominal controls, each onto its own half-spaces and box; statuses and answers are those of `project`.

    Inactive controls are the nominal ones bit for bit, the others equal within the accuracy of the solver.

    Args:
        u_nom: Nominal controls, shape (B, m), finite.
        normals: Row normals, shape (B, k, m). Rows that ask for nothing fill up a problem with fewer rows: a zero
            normal and an offset of +inf.
        offsets: Shape (B, k).
        lower: Box, shape (m,) or (B, m); -inf is no bound.
        upper: Box, shape (m,) or (B, m); +inf is no bound.
        solver: As in `project`.

    Raises:
        ConfigurationError: Shapes do not match, bounds cross, or an argument that must be finite is not.
        UnknownNameError: No such solver is installed.
    """
    check_solver(solver)
    u = np.array(u_nom, dtype=np.float64)
    a, b = np.asarray(normals, dtype=np.float64), np.asarray(offsets, dtype=np.float64)
    if u.ndim != 2 or b.ndim != 2 or len(b) != len(u) or a.shape != (*b.shape, u.shape[1]):
        wanted = "u_nom (B, m), normals (B, k, m) and offsets (B, k)"
        raise ConfigurationError(f"expected {wanted}; got {u.shape}, {a.shape} and {b.shape}")
    try:
        lo = np.broadcast_to(np.asarray(lower, dtype=np.float64), u.shape)
        hi = np.broadcast_to(np.asarray(upper, dtype=np.float64), u.shape)
    except ValueError:
        wanted, given = f"({u.shape[1]},) or {u.shape}", f"{np.shape(lower)} and {np.shape(upper)}"
        raise ConfigurationError(f"expected bounds of shape {wanted}; got {given}") from None
    if not np.isfinite(u).all():
        where = np.flatnonzero(~np.isfinite(u).all(axis=1)).tolist()
        raise ConfigurationError(f"u_nom must be finite, replace it before projecting; rows {where} are not")
    if not (lo <= hi).all():  # also refuses NaN
        raise ConfigurationError(f"lower must not exceed upper, got {lo} and {hi}")
    with np.errstate(all="ignore"):  # numbers that overflow are left to `project`
        answer, solved = _without_solver(u, a, b, lo, hi)
    for i in np.flatnonzero(~solved):
        one = project_unchecked(u[i], a[i], b[i], lo[i], hi[i], solver)
        answer.controls[i], answer.status[i], answer.violation[i], answer.multipliers[i] = one[:4]
    return answer


def _without_solver(u: Array, a: Array, b: Array, lo: Array, hi: Array) -> tuple[BatchProjection, Mask]:
    """The answers that need no solver, and which of the problems have one."""
    count, k = b.shape
    status = np.full(count, Status.INACTIVE, dtype="<U10")
    answer = BatchProjection(u, status, np.zeros(count), np.zeros((count, k)))
    inside: Mask = np.asarray(((u >= lo) & (u <= hi)).all(axis=1))
    if k == 0:
        status[~inside] = Status.PROJECTED
        u[~inside] = np.clip(u, lo, hi)[~inside]
        return answer, np.ones(count, dtype=bool)
    length = np.sqrt(np.einsum("bkm,bkm->bk", a, a))
    excess = np.einsum("bkm,bm->bk", a, u) - b
    # An offset of +inf asks for nothing, so its row may have any finite normal.
    ordinary = ((length < _LARGEST) & (b > -_LARGEST) & ((b < _LARGEST) | (b == np.inf))).all(axis=1)
    solved = ordinary & inside & (excess <= 0.0).all(axis=1)
    left = np.flatnonzero(ordinary & ~solved)
    if left.size < _FEW:
        return answer, solved
    u, a, b, lo, hi, length, excess = (part[left] for part in (u, a, b, lo, hi, length, excess))
    slack = FEASIBILITY_TOLERANCE * batch_residual_scales(u, a, b, length, lo, hi)
    within = inside[left]
    near = within & (excess <= (1.0 - _CLEAR) * slack).all(axis=1)
    maybe = within & (excess <= (1.0 + _CLEAR) * slack).all(axis=1)
    each = np.arange(left.size)
    worst = np.where(length > 0.0, excess / length, np.where(excess > 0.0, np.inf, -np.inf)).argmax(axis=1)
    control, multiplier = _on_one_row(u, a[each, worst], b[each, worst], lo, hi, slack[each, worst])
    residual = np.einsum("bkm,bm->bk", a, control) - b
    kept = residual <= -_SPARE * slack
    kept[each, worst] = residual[each, worst] <= EXACT_SHARE * slack[each, worst]
    projected = ~maybe & kept.all(axis=1)
    beyond = residual[each, worst] > (1.0 + _CLEAR) * 10.0 * slack[each, worst]
    infeasible = ~maybe & beyond & ((b < np.inf).sum(axis=1) == 1)
    answered = projected | infeasible
    status[left[projected]], status[left[infeasible]] = Status.PROJECTED, Status.INFEASIBLE
    answer.controls[left[answered]] = control[answered]
    answer.violation[left[answered]] = np.maximum(0.0, residual[answered].max(axis=1))
    answer.multipliers[left[projected], worst[projected]] = multiplier[projected]
    solved[left[near | answered]] = True
    return answer, solved


def _on_one_row(
    u: Array, normal: Array, limit: Array, lo: Array, hi: Array, slack: Array
) -> tuple[Array, Array]:
    """`project_single_row` for many: controls and multipliers; NaN where they overflow."""
    square = normal * normal
    ends = (u - hi) / normal, (u - lo) / normal
    enter, leave = np.minimum(*ends), np.maximum(*ends)
    moves = (normal != 0.0) & (leave > 0.0)
    later = moves & (enter > 0.0)
    at = np.concatenate([np.where(later, enter, np.inf), np.where(moves, leave, np.inf)], axis=1)
    change = np.concatenate([square, -square], axis=1)
    order = at.argsort(axis=1)
    # The row's value falls with the multiplier, piecewise linearly: where each piece starts, and how it falls there.
    start = np.concatenate([np.zeros((len(u), 1)), np.take_along_axis(at, order, axis=1)], axis=1)
    first = np.where(moves & ~later, square, 0.0).sum(axis=1, keepdims=True)
    falling = np.cumsum(np.concatenate([first, np.take_along_axis(change, order, axis=1)], axis=1), axis=1)
    value = (normal * np.clip(u, lo, hi)).sum(axis=1, keepdims=True)
    values = np.cumsum(np.concatenate([value, -falling[:, :-1] * np.diff(start)], axis=1), axis=1)
    above = (values > limit[:, None]) & (start < np.inf)
    piece = np.arange(len(u)), above[:, 1:].sum(axis=1)
    rest = np.where(falling[piece] > 0.0, (values[piece] - limit) / falling[piece], 0.0)
    multiplier = np.where(above[:, 0], start[piece] + rest, 0.0)
    multiplier[(later & np.isinf(enter)).any(axis=1)] = np.nan
    control = np.clip(u - multiplier[:, None] * normal, lo, hi)
    missing = (normal * control).sum(axis=1) - limit
    slope = np.where((lo < control) & (control < hi), square, 0.0).sum(axis=1)
    multiplier += np.where((missing > slack) & (slope > 0.0), missing / slope, 0.0)
    return np.clip(u - multiplier[:, None] * normal, lo, hi), multiplier
