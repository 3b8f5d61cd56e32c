"""Axis-aligned rectangles in the plane: how far apart two are, and fewer of them that cover the same."""

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
    """Signed distance, m: Euclidean outside; inside, minus the shortest way along an axis that separates them."""
    across = max(a[0] - b[1], b[0] - a[1])
    along = max(a[2] - b[3], b[2] - a[3])
    if across > 0.0 and along > 0.0:
        return math.hypot(across, along)
    return across if across > along else along


def merged(rectangles: Iterable[Rectangle]) -> list[Rectangle]:
    """Rectangles that cover the same area, with touching ones of equal side joined: first along x, then along y."""
    along_x = _joined(rectangles, 0)
    return _joined(along_x, 2)


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
