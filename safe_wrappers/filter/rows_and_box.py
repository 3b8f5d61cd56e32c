"""One projection in one compiled call: is the nominal admissible, which control is closest, what violates least."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array
from safe_wrappers.control.numerics.active_set import (
    ALLOWED,
    CONTRADICTORY,
    EXCESS,
    HIGH,
    LENGTH,
    LOW,
    NEAR,
    OFFSET,
    SLACK,
    SOLVED,
    TARGET,
    WEIGHT,
    X,
    closest_point,
    search_space,
)
from safe_wrappers.control.numerics.compiled import compiled, inlined
from safe_wrappers.filter.problem import EXACT_SHARE, FEASIBILITY_TOLERANCE, half_width, residual_scale

INACTIVE, PROJECTED, INFEASIBLE, UNSOLVED, SEVERAL_ROWS, UNUSUAL, BAD_NOMINAL, BAD_BOX, _READ = range(9)
"""How it ended: the first three as a `Status`; no answer; a problem for a named solver; a number too large to be
squared, or NaN; a nominal that is not finite; bounds that cross."""

LARGEST: Final = 1e150
"""From here on squares may overflow."""
OVERFLOWING: Final = 1e300
"""An offset from here on asks for nothing."""
_SHORTEST: Final = 1e-150  # rows below this are zero
_SOFT: Final = 1e-10  # weight of the distance from the nominal beside squared violations
_ROUNDING: Final = 1e-15  # share of the numbers that are compared which round-off may leave
_OPTIMAL: Final = (
    1e-9  # what the multipliers' control may differ from the answer by, as a share of the controls
)


@inlined
def _read(
    u: Array,
    normals: Array,
    offsets: Array,
    lower: Array,
    upper: Array,
    point: Array,
    columns: Array,
    rows: Array,
    control: Array,
) -> tuple[int, bool]:
    """Copy a problem: whether it can be worked with, and whether the nominal is inside the box."""
    usual, inside = True, True
    for j in range(u.size):
        x, low, high = u[j], lower[j], upper[j]
        if not math.isfinite(x):
            return BAD_NOMINAL, False
        if not low <= high:
            return BAD_BOX, False
        control[j] = min(max(x, low), high)
        point[TARGET, j], point[LOW, j], point[HIGH, j], point[X, j] = x, low, high, control[j]
        inside = inside and low <= x <= high
        usual = usual and abs(x) < LARGEST and abs(control[j]) < LARGEST
    for i in range(offsets.size):
        for j in range(u.size):
            usual = usual and abs(normals[i, j]) < LARGEST
            columns[j, i] = normals[i, j]
        idle = offsets[i] >= OVERFLOWING
        usual = usual and (idle or abs(offsets[i]) < OVERFLOWING)
        rows[OFFSET, i] = offsets[i]
    return _READ if usual else UNUSUAL, inside


@inlined
def _excess(point: Array, columns: Array, rows: Array, x: int) -> float:
    """By how much a point violates each row, in `EXCESS`, and the largest, at least 0."""
    m, k = columns.shape
    for i in range(k):
        rows[EXCESS, i] = -rows[OFFSET, i]
    for j in range(m):
        for i in range(k):
            rows[EXCESS, i] += columns[j, i] * point[x, j]
    worst = 0.0
    for i in range(k):
        worst = max(worst, rows[EXCESS, i])
    return worst


@inlined
def _within(rows: Array, slacks: Array, share: float) -> bool:
    """Whether no row is violated by more than that share of its slack."""
    within = True
    for i in range(slacks.size):
        within = within and rows[EXCESS, i] <= share * slacks[i]
    return within


@inlined
def _measure(point: Array, columns: Array, rows: Array, slacks: Array) -> int:
    """What is small in this problem, to `slacks`, `ALLOWED` and `NEAR`; how many rows ask for anything."""
    m, k = columns.shape
    largest = widest = farthest = 0.0
    for j in range(m):
        point[NEAR, j] = half_width(point[LOW, j], point[HIGH, j])
        widest, largest = max(widest, point[NEAR, j]), max(largest, abs(point[TARGET, j]))
        farthest = max(farthest, abs(point[X, j]))
    asking = 0
    for i in range(k):
        length = box = 0.0
        for j in range(m):
            length += columns[j, i] * columns[j, i]
        length = math.sqrt(length)
        for j in range(m if length > 0.0 else 0):
            part = columns[j, i] / length * point[NEAR, j]
            box += part * part
        offset = abs(rows[OFFSET, i])
        scale = residual_scale(length * math.sqrt(box), length, length * largest + offset, widest)
        slacks[i] = FEASIBILITY_TOLERANCE * scale
        rounding = _ROUNDING * (length * max(largest, farthest) + offset)
        rows[ALLOWED, i], rows[SLACK, i] = max(EXACT_SHARE * slacks[i], rounding), 0.0
        rows[LENGTH, i] = length if length > _SHORTEST and offset < OVERFLOWING else 0.0
        asking += 1 if rows[LENGTH, i] > 0.0 else 0
    for j in range(m):
        scale = residual_scale(point[NEAR, j], 1.0, largest, widest)
        rounding = _ROUNDING * max(largest, farthest)
        point[NEAR, j] = max(EXACT_SHARE * FEASIBILITY_TOLERANCE * scale, rounding)
    return asking


@compiled
def _judge(point: Array, columns: Array, rows: Array) -> bool:
    """Put an answer into the box: whether it keeps the rows, and the multipliers lead to it from the nominal."""
    m, k = columns.shape
    size = 0.0
    for j in range(m):
        point[X, j] = min(max(point[X, j], point[LOW, j]), point[HIGH, j])
        size = max(size, abs(point[TARGET, j]), abs(point[X, j]))
    _excess(point, columns, rows, X)
    for i in range(k):
        if rows[LENGTH, i] > 0.0 and not rows[EXCESS, i] <= 2.0 * rows[ALLOWED, i]:
            return False
    for j in range(m):
        pulled, pull = point[TARGET, j], 0.0
        for i in range(k):
            step = rows[WEIGHT, i] * columns[j, i]
            pulled, pull = pulled - step, pull + abs(step)
        away = abs(min(max(pulled, point[LOW, j]), point[HIGH, j]) - point[X, j])
        if not away <= _OPTIMAL * size + 10.0 * _ROUNDING * pull + point[NEAR, j]:
            return False
    return True


@compiled
def _violate_least(point: Array, columns: Array, rows: Array) -> bool:
    """What violates the rows least, and of that the closest to the nominal, to `X` and `WEIGHT`."""
    m, k = columns.shape
    near, _, softened, along, factors, active = search_space(m, k, True)
    for i in range(k):
        for row in range(SLACK):
            softened[row, i] = rows[row, i]
        softened[SLACK, i] = math.sqrt(_SOFT) * rows[LENGTH, i]
    for j in range(m):
        for row in range(X):
            near[row, j] = point[row, j]
    ended, _ = closest_point(near, columns, softened, along, factors, active)
    for j in range(m):
        point[X, j] = min(max(near[X, j], point[LOW, j]), point[HIGH, j])
    for i in range(k):
        rows[WEIGHT, i] = softened[WEIGHT, i]
    return ended == SOLVED and _excess(point, columns, rows, X) < math.inf


@compiled
def _to_corner(point: Array, columns: Array, rows: Array) -> bool:
    """What violates the only row that asks least, to `X` and `WEIGHT`: the corner against it, if there is one."""
    m, k = columns.shape
    for i in range(k):
        if rows[LENGTH, i] > 0.0:
            rows[WEIGHT, i] = 0.0
            for j in range(m):
                target, slope = point[TARGET, j], columns[j, i]
                corner = point[LOW, j] if slope > 0.0 else point[HIGH, j] if slope < 0.0 else target
                point[X, j] = min(max(corner, point[LOW, j]), point[HIGH, j])
                if not abs(point[X, j]) < LARGEST:
                    return False
                if slope != 0.0:
                    rows[WEIGHT, i] = max(rows[WEIGHT, i], (target - point[X, j]) / slope)
    return True


@inlined
def _keep_rows(
    u: Array,
    normals: Array,
    offsets: Array,
    lower: Array,
    upper: Array,
    named: bool,
    control: Array,
    multipliers: Array,
    slacks: Array,
    point: Array,
    columns: Array,
    rows: Array,
    along: Array,
    factors: Array,
    active: NDArray[np.int64],
) -> tuple[int, float, int]:
    """`keep_rows` in a given space: how it ended, the violation, the number of changes of the active set."""
    m, k = columns.shape
    ended, inside = _read(u, normals, offsets, lower, upper, point, columns, rows, control)
    for i in range(k):
        multipliers[i] = 0.0
    if ended != _READ:
        return ended, math.inf, 0
    if _excess(point, columns, rows, TARGET) == 0.0 and inside:
        return INACTIVE, 0.0, 0
    asking = _measure(point, columns, rows, slacks)
    if inside and _within(rows, slacks, 1.0):
        return INACTIVE, 0.0, 0
    if named and asking > 1:
        return SEVERAL_ROWS, math.inf, 0
    ended, steps = closest_point(point, columns, rows, along, factors, active)
    solved = ended == SOLVED and _judge(point, columns, rows)
    if ended == CONTRADICTORY:
        solved = asking == 1 and _to_corner(point, columns, rows)
        solved = solved or _violate_least(point, columns, rows)
    for j in range(m):
        if solved:
            control[j] = point[X, j]
        else:
            point[X, j] = control[j]
    violation = _excess(point, columns, rows, X)
    if not solved:
        return UNSOLVED, violation, steps
    if not _within(rows, slacks, 10.0):
        return INFEASIBLE, violation, steps
    for i in range(k):
        multipliers[i] = rows[WEIGHT, i]
    return PROJECTED, violation, steps


@compiled
def keep_rows(
    u: Array,
    normals: Array,
    offsets: Array,
    lower: Array,
    upper: Array,
    named: bool,
    control: Array,
    multipliers: Array,
) -> tuple[int, float, int]:
    """The control closest to `u` in the rows and the box.

    Args:
        u: Shape (m,); all arrays are of float64, contiguous and writeable.
        normals: Shape (k, m).
        offsets: Shape (k,).
        lower: Shape (m,).
        upper: Shape (m,).
        named: Leave problems of several rows to a named solver.
        control: Written to, shape (m,).
        multipliers: Written to, shape (k,).

    Returns:
        INACTIVE and so on, the violation, the number of changes of the active set.
    """
    problem = u, normals, offsets, lower, upper, named, control, multipliers
    return _keep_rows(*problem, np.zeros(offsets.size), *search_space(u.size, offsets.size, False))


@compiled
def keep_rows_of_each(
    u: Array,
    normals: Array,
    offsets: Array,
    lower: Array,
    upper: Array,
    named: bool,
    controls: Array,
    multipliers: Array,
    violations: Array,
    ended: NDArray[np.int64],
) -> None:
    """`keep_rows` for B problems: B is the first dimension of every array."""
    slacks = np.zeros(offsets.shape[1])
    point, columns, rows, along, factors, active = search_space(u.shape[1], offsets.shape[1], False)
    for i in range(u.shape[0]):
        ended[i], violations[i], _ = _keep_rows(
            u[i],
            normals[i],
            offsets[i],
            lower[i],
            upper[i],
            named,
            controls[i],
            multipliers[i],
            slacks,
            point,
            columns,
            rows,
            along,
            factors,
            active,
        )


@compiled
def row_slacks(
    u: Array, normals: Array, offsets: Array, lower: Array, upper: Array
) -> tuple[bool, Array, Array]:
    """Whether a control keeps the rows as closely as an answer must; slacks and lengths of the rows, shape (k,).

    The arguments are those of `keep_rows`. The slacks are what a nominal may miss the rows by, in their units; a row
    that asks for nothing has length 0.
    """
    m, k = u.size, offsets.size
    slacks, control = np.zeros(k), np.zeros(m)
    point, columns, rows, _, _, _ = search_space(m, k, False)
    kept = _read(u, normals, offsets, lower, upper, point, columns, rows, control)[0] == _READ
    if kept:  # what overflows would be allowed anything
        _measure(point, columns, rows, slacks)
        _excess(point, columns, rows, TARGET)
        kept = _within(rows, slacks, 10.0)
    return kept, slacks, rows[LENGTH].copy()
