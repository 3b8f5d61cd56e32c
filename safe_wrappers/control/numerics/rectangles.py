"""Axis-aligned rectangles in the plane: distances, and merging of adjacent ones.

The signed distance is Euclidean outside and, where two rectangles overlap, minus the shortest translation along an
axis that separates them. Plain floats: at this size they are faster than arrays.
"""

import math
from collections.abc import Iterable

Rectangle = tuple[float, float, float, float]
"""x from, x to, y from, y to, m."""

_TOUCHING = 1e-9
"""m; edges closer than this are one edge."""


def gaps(a: Rectangle, b: Rectangle) -> tuple[float, float]:
    """Signed gap along x and along y, m; negative where the rectangles overlap along that axis."""
    return max(a[0] - b[1], b[0] - a[1]), max(a[2] - b[3], b[2] - a[3])


def apart(a: Rectangle, b: Rectangle) -> float:
    """Signed distance of two rectangles, m."""
    across, along = gaps(a, b)
    return math.hypot(across, along) if across > 0.0 and along > 0.0 else max(across, along)


def closer(around: Rectangle, among: Iterable[Rectangle], limit: float) -> list[Rectangle]:
    """The rectangles that are closer than `limit` >= 0, m."""
    wide = limit + _TOUCHING  # sums and differences are rounded, and `apart` decides
    x0, x1, y0, y1 = around[0] - wide, around[1] + wide, around[2] - wide, around[3] + wide
    found = [r for r in among if r[0] < x1 and r[1] > x0 and r[2] < y1 and r[3] > y0]
    # Near a corner the Euclidean distance may be larger than along either axis.
    return [r for r in found if apart(around, r) < limit] if found else found


def nearest(around: Rectangle, among: Iterable[Rectangle], limit: float) -> tuple[float, Rectangle | None]:
    """The smallest distance below `limit` and the rectangle it belongs to, or the limit and None."""
    best, found = limit, None
    x0, x1, y0, y1 = around
    for r in among:
        a, b = r[0] - x1, x0 - r[1]
        across = a if a > b else b
        if across >= best:
            continue
        a, b = r[2] - y1, y0 - r[3]
        along = a if a > b else b
        if along >= best:
            continue
        outside = across > 0.0 and along > 0.0
        distance = math.hypot(across, along) if outside else max(across, along)
        if distance < best:
            best, found = distance, r
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
