"""Axis-aligned rectangles in the plane: distances, and merging of adjacent ones.

The signed distance is Euclidean outside and, where two rectangles overlap, minus the shortest translation along an
axis that separates them.
"""

from collections.abc import Iterable
from typing import Final

from safe_wrappers.checks import Array
from safe_wrappers.control.numerics.compiled import compiled, hypot

Rectangle = tuple[float, float, float, float]
"""x from, x to, y from, y to, m."""

_TOUCHING: Final = 1e-9
"""m; edges closer than this are one edge."""


@compiled
def gaps(a: Rectangle, b: Rectangle) -> tuple[float, float]:
    """Signed gap along x and along y, m; negative where the rectangles overlap along that axis."""
    return max(a[0] - b[1], b[0] - a[1]), max(a[2] - b[3], b[2] - a[3])


@compiled
def apart(a: Rectangle, b: Rectangle) -> float:
    """Signed distance of two rectangles, m."""
    across, along = gaps(a, b)
    return hypot(across, along) if across > 0.0 and along > 0.0 else max(across, along)


@compiled
def one_of(rectangles: Array, i: int) -> Rectangle:
    """A rectangle of several, shape (n, 4)."""
    return rectangles[i, 0], rectangles[i, 1], rectangles[i, 2], rectangles[i, 3]


@compiled
def closer(around: Rectangle, among: Array, limit: float, first: int = 0) -> int:
    """The first of several, shape (n, 4), from an index on, that is closer than `limit` >= 0, m; -1: none is."""
    wide = limit + _TOUCHING  # sums and differences are rounded, and `apart` decides
    x0, x1, y0, y1 = around[0] - wide, around[1] + wide, around[2] - wide, around[3] + wide
    for i in range(first, len(among)):
        close = among[i, 0] < x1 and among[i, 1] > x0 and among[i, 2] < y1 and among[i, 3] > y0
        # Near a corner the Euclidean distance may be larger than along either axis.
        if close and apart(around, one_of(among, i)) < limit:
            return i
    return -1


@compiled
def nearest(around: Rectangle, among: Array, limit: float) -> tuple[float, int]:
    """The smallest distance below `limit` and the rectangle it belongs to, or the limit and -1."""
    best, found = limit, -1
    for i in range(len(among)):
        across, along = gaps(around, one_of(among, i))
        if across >= best or along >= best:
            continue
        distance = apart(around, one_of(among, i))
        if distance < best:
            best, found = distance, i
    return best, found


def merged(rectangles: Iterable[Rectangle]) -> list[Rectangle]:
    """Rectangles that cover the same area, touching ones of equal side joined: first along x, then along y."""
    return _joined(_joined(rectangles, 0), 2)


def _joined(rectangles: Iterable[Rectangle], axis: int) -> list[Rectangle]:
    other = 2 - axis
    out: list[Rectangle] = []
    for r in sorted(rectangles, key=lambda r: (r[other], r[other + 1], r[axis])):
        if out and _continues(out[-1], r, axis, other):
            last = out.pop()
            longer = last[axis], max(last[axis + 1], r[axis + 1])
            out.append((*longer, *last[2:]) if axis == 0 else (*last[:2], *longer))
        else:
            out.append(r)
    return out


def _continues(last: Rectangle, r: Rectangle, axis: int, other: int) -> bool:
    level = abs(last[other] - r[other]) + abs(last[other + 1] - r[other + 1]) <= _TOUCHING
    return level and r[axis] <= last[axis + 1] + _TOUCHING
