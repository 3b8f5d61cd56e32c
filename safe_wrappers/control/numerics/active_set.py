"""The point of a box that is closest to a given one and keeps several half-spaces: a dual active set.

Source: Goldfarb and Idnani, "A numerically stable dual method for solving strictly convex quadratic programs",
Mathematical Programming 27 (1983). The Hessian is the identity, so the factorisation is that of the active normals:
an orthonormal basis and a triangle, over the components that no bound holds. Components at a bound are left out of
it, which keeps them there exactly. Every iterate is the closest point to the active set, and the set grows by the
condition that is violated most, so the first iterate that keeps everything is the answer.

What a search reads and writes lies in few arrays, because every array that is handed on costs time. The normals are
stored as columns: sums over the components then run over all half-spaces at once, in the same order.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array
from safe_wrappers.control.numerics.compiled import compiled, inlined

SOLVED: Final = 0
CONTRADICTORY: Final = 1
"""No point of the box keeps every half-space."""
GAVE_UP: Final = 2

TARGET, LOW, HIGH, NEAR, X, SIDE, PRESSURE, PUSH, NORMAL, REST = range(10)
"""Rows of the space's `point`, m entries each: the point to be close to, the box, what a bound may be violated by
before it is held; the iterate, where it is held (-1, 1; 0: free), the multipliers of those bounds and their change
per unit of the multiplier that enters; the normal that enters, and what the basis does not span of it."""
OFFSET, LENGTH, ALLOWED, SLACK, WEIGHT, EXCESS = range(6)
"""Rows of its `rows`, k entries each: offsets, lengths of the normals (0: left out), what a half-space may be
violated by, its slack (0: it must be kept), its multiplier, by how much the iterate violates it."""
SHARE, CHANGE = range(2)
"""Rows of its `along`: of the normal that enters, the coefficients in the basis and in the active normals."""

_DEPENDENT: Final = 1e-13
"""Share of a normal that must be left beside the active ones: less is round-off."""
_CANCELLED: Final = 0.25
"""Share of a squared length below which so much was taken out of it that round-off must be taken out, too."""


Space = tuple[Array, Array, Array, Array, Array, NDArray[np.int64]]
"""What a search reads and writes; reused over the problems of a batch.

* point: see `TARGET` and what follows it; behind the m entries of a row those of the slacks
* normals: of the half-spaces, shape (m, k)
* rows: see `OFFSET`
* along: see `SHARE`
* factors: of each active normal the row of the basis, and behind it its column of the triangle
* active: half-spaces that hold with equality, in the order of the basis
"""


@compiled
def search_space(m: int, k: int, softened: bool) -> Space:
    """For points of m components and k half-spaces; softened, more of them can be active at once."""
    most = k if softened else min(m, k)
    wide = m + most if softened else m
    along, factors = np.zeros((2, most)), np.zeros((most, wide + most))
    return np.zeros((10, wide)), np.zeros((m, k)), np.zeros((6, k)), along, factors, np.zeros(most, np.int64)


@inlined
def _split(point: Array, along: Array, factors: Array, count: int, whole: float) -> float:
    """Take what the first rows of the basis span out of `REST`, whose square is `whole`; the square that is left."""
    wide, square = point.shape[1], whole
    for a in range(count):
        along[SHARE, a] = 0.0
    for once_more in range(2 if count else 0):
        if once_more and square > _CANCELLED * whole:
            return square  # little was taken, so little is round-off
        for a in range(count):
            part = 0.0
            for j in range(wide):
                part += factors[a, j] * point[REST, j]
            for j in range(wide):
                point[REST, j] -= part * factors[a, j]
            along[SHARE, a] += part
        square = 0.0
        for j in range(wide):
            square += point[REST, j] * point[REST, j]
    return square


@inlined
def _append(point: Array, along: Array, factors: Array, place: int, square: float) -> None:
    """`REST` and `SHARE` as the row and the column at a place of the factorisation."""
    wide, size = point.shape[1], math.sqrt(square)
    for j in range(wide):
        factors[place, j] = point[REST, j] / size
    for a in range(place):
        factors[place, wide + a] = along[SHARE, a]
    factors[place, wide + place] = size


@compiled
def _factor(
    normals: Array,
    rows: Array,
    point: Array,
    along: Array,
    factors: Array,
    active: NDArray[np.int64],
    start: int,
    count: int,
) -> bool:
    """Factor the active normals from one place on; False if they depend on each other."""
    m, wide = normals.shape[0], point.shape[1]
    for a in range(start, count):
        i, whole = active[a], 0.0
        for j in range(m):
            point[REST, j] = normals[j, i] if point[SIDE, j] == 0.0 else 0.0
        for j in range(m, wide):
            point[REST, j] = -rows[SLACK, i] if j == m + a else 0.0
        for j in range(wide):
            whole += point[REST, j] * point[REST, j]
        square = _split(point, along, factors, a, whole)
        if not square > _DEPENDENT * _DEPENDENT * whole:
            return False
        _append(point, along, factors, a, square)
    return True


@inlined
def _in_normals(along: Array, factors: Array, wide: int, count: int) -> None:
    """`SHARE` in the basis to multiples of the active normals, `CHANGE`."""
    for a in range(count - 1, -1, -1):
        value = along[SHARE, a]
        for c in range(a + 1, count):
            value -= factors[c, wide + a] * along[CHANGE, c]
        along[CHANGE, a] = value / factors[a, wide + a]


@compiled
def _polish(
    normals: Array,
    rows: Array,
    point: Array,
    along: Array,
    factors: Array,
    active: NDArray[np.int64],
    count: int,
) -> None:
    """The iterate of the active set anew from the target, and again from what rounding left of it."""
    m, wide = normals.shape[0], point.shape[1]
    for j in range(m):
        if point[SIDE, j] == 0.0:
            point[X, j] = point[TARGET, j]
    for a in range(count):
        rows[WEIGHT, active[a]] = 0.0
    for _ in range(2):
        for a in range(count):
            i = active[a]
            value = -rows[OFFSET, i] - rows[SLACK, i] * rows[SLACK, i] * rows[WEIGHT, i]
            for j in range(m):
                value += normals[j, i] * point[X, j]
            for c in range(a):
                value -= factors[a, wide + c] * along[SHARE, c]
            along[SHARE, a] = value / factors[a, wide + a]
        for a in range(count):
            for j in range(m):
                point[X, j] -= along[SHARE, a] * factors[a, j]
        _in_normals(along, factors, wide, count)
        for a in range(count):
            rows[WEIGHT, active[a]] += along[CHANGE, a]
    for a in range(count):
        rows[WEIGHT, active[a]] = max(0.0, rows[WEIGHT, active[a]])
    for j in range(m):
        if point[SIDE, j] != 0.0:
            pulled = point[TARGET, j] - point[X, j]
            for a in range(count):
                pulled -= rows[WEIGHT, active[a]] * normals[j, active[a]]
            point[PRESSURE, j] = max(0.0, point[SIDE, j] * pulled)


@inlined
def _most_violated(
    normals: Array, rows: Array, point: Array, active: NDArray[np.int64], count: int
) -> tuple[int, float]:
    """A half-space (below k), an upper bound (k + j), a lower one (k + m + j), or -1; by how much."""
    m, k = normals.shape
    chosen, worst, excess = -1, 0.0, 0.0
    for i in range(k):
        rows[EXCESS, i] = -rows[OFFSET, i]
    for j in range(m):
        for i in range(k):
            rows[EXCESS, i] += normals[j, i] * point[X, j]
    for i in range(k):
        over = rows[EXCESS, i]
        if over > rows[ALLOWED, i] and rows[LENGTH, i] > 0.0 and over > worst * rows[LENGTH, i]:
            held = False
            for a in range(count):
                held = held or active[a] == i
            if not held:
                chosen, worst, excess = i, over / rows[LENGTH, i], over
    for j in range(m):
        if point[SIDE, j] == 0.0:
            over = point[X, j] - point[HIGH, j]
            if over > point[NEAR, j] and over > worst:
                chosen, worst, excess = k + j, over, over
            over = point[LOW, j] - point[X, j]
            if over > point[NEAR, j] and over > worst:
                chosen, worst, excess = k + m + j, over, over
    return chosen, excess


@inlined
def _first_used_up(
    normals: Array,
    rows: Array,
    point: Array,
    along: Array,
    active: NDArray[np.int64],
    count: int,
    length: float,
) -> tuple[float, int]:
    """How far the entering multiplier grows until an active one is zero, and its place: row a, or bound count + j."""
    used, place = math.inf, -1
    for a in range(count):
        i, change = active[a], along[CHANGE, a]
        if change * rows[LENGTH, i] > _DEPENDENT * length and rows[WEIGHT, i] < used * change:
            used, place = rows[WEIGHT, i] / change, a
    for j in range(normals.shape[0]):
        point[PUSH, j] = 0.0
        if point[SIDE, j] != 0.0:
            push = point[NORMAL, j]
            for a in range(count):
                push -= along[CHANGE, a] * normals[j, active[a]]
            push *= point[SIDE, j]
            point[PUSH, j] = push
            if push > _DEPENDENT * length and point[PRESSURE, j] < used * push:
                used, place = point[PRESSURE, j] / push, count + j
    return used, place


@compiled
def _enter(
    normals: Array,
    rows: Array,
    point: Array,
    along: Array,
    factors: Array,
    active: NDArray[np.int64],
    count: int,
    chosen: int,
    over: float,
) -> tuple[int, int, int]:
    """Add one condition, violated by `over`, and drop those whose multipliers it uses up on the way.

    Returns:
        How many half-spaces are active; SOLVED, CONTRADICTORY or GAVE_UP; steps.
    """
    m, k = normals.shape
    wide, most = point.shape[1], 10 * (m + k)
    bound, side, slack, length, weight = -1, 0.0, 0.0, 1.0, 0.0
    for j in range(m):
        point[NORMAL, j] = normals[j, chosen] if chosen < k else 0.0
    if chosen < k:
        slack, length = rows[SLACK, chosen], rows[LENGTH, chosen]
    else:
        bound, side = (chosen - k) % m, 1.0 if chosen < k + m else -1.0
        point[NORMAL, bound] = side
    for steps in range(1, most):
        whole, start = slack * slack, 0
        for j in range(m):
            point[REST, j] = point[NORMAL, j] if point[SIDE, j] == 0.0 else 0.0
            whole += point[REST, j] * point[REST, j]
        for j in range(m, wide):
            point[REST, j] = -slack if j == m + count else 0.0
        square = _split(point, along, factors, count, whole)
        _in_normals(along, factors, wide, count)
        used, place = _first_used_up(normals, rows, point, along, active, count, length)
        holds = math.inf
        if square > _DEPENDENT * _DEPENDENT * whole:
            holds = max(over, 0.0) / square
            step = min(used, holds)
            over -= step * square
            for j in range(m):
                point[X, j] -= step * point[REST, j]
        step = min(used, holds)
        if not step < math.inf:
            return count, CONTRADICTORY, steps
        weight += step
        for j in range(m):
            point[PRESSURE, j] = max(0.0, point[PRESSURE, j] - step * point[PUSH, j])
        for a in range(count):
            i = active[a]
            rows[WEIGHT, i] = max(0.0, rows[WEIGHT, i] - step * along[CHANGE, a])
        if holds <= used and bound < 0:
            _append(point, along, factors, count, square)
            active[count], rows[WEIGHT, chosen] = chosen, weight
            return count + 1, SOLVED, steps
        if holds <= used:
            point[SIDE, bound], point[PRESSURE, bound] = side, weight
            point[X, bound] = point[HIGH, bound] if side > 0.0 else point[LOW, bound]
        elif place >= count:
            point[SIDE, place - count] = 0.0
        else:
            start, count = place, count - 1
            rows[WEIGHT, active[place]] = 0.0
            for a in range(place, count):
                active[a] = active[a + 1]
        if not _factor(normals, rows, point, along, factors, active, start, count):
            return count, GAVE_UP, steps
        if holds <= used:
            return count, SOLVED, steps
    return count, GAVE_UP, most


@compiled
def closest_point(
    point: Array, normals: Array, rows: Array, along: Array, factors: Array, active: NDArray[np.int64]
) -> tuple[int, int]:
    """The x that minimises `|x - target|^2` with `x @ normals <= offsets` and `low <= x <= high`.

    With slacks it minimises `|x - target|^2 + sum of (violation / slack)^2` over the box: there is always an answer,
    and the multipliers are the violations over the squared slacks. The caller judges the answer.

    The arguments are a `Space` with the rows TARGET to NEAR, the normals, and OFFSET to SLACK written, all finite but
    for the box. The answer is in X and WEIGHT.

    Returns:
        SOLVED, CONTRADICTORY or GAVE_UP, and the number of changes of the active set.
    """
    m, k = normals.shape
    for i in range(k):
        rows[WEIGHT, i] = 0.0
    for j in range(m):
        target = point[TARGET, j]
        point[X, j] = min(max(target, point[LOW, j]), point[HIGH, j])
        point[SIDE, j] = 1.0 if target > point[X, j] else -1.0 if target < point[X, j] else 0.0
        point[PRESSURE, j] = abs(target - point[X, j])
    count = steps = 0 * k  # a variable: for the literal 0 everything would be compiled once more
    while steps < 10 * (m + k):
        chosen, over = _most_violated(normals, rows, point, active, count)
        if chosen < 0:
            _polish(normals, rows, point, along, factors, active, count)
            return SOLVED, steps
        count, ended, more = _enter(normals, rows, point, along, factors, active, count, chosen, over)
        steps += more
        if ended != SOLVED:
            return ended, steps
    return GAVE_UP, steps
