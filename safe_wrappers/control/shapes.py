"""Shapes: discs as a learner sees them, convex outlines and axis-aligned rectangles."""

import math
from collections.abc import Iterable
from typing import Final

import numpy as np

from safe_wrappers.control.compiled import compiled, hypot
from safe_wrappers.errors import Array, ConfigurationError

Rectangle = tuple[float, float, float, float]
"""x from, x to, y from, y to, m."""
NUMBERS: Final = 4
"""Of each disc that a learner is shown."""
_TOUCHING: Final = 1e-9
"""m; edges closer than this are one edge."""


@compiled
def squashed(value: float, scale: float) -> float:
    """From a number of any size to one in [-1, 1], monotone; slope 1 / scale at 0, and +-0.5 at +-scale."""
    return math.copysign(1.0, value) if math.isinf(value) else value / (scale + abs(value))


@compiled
def nearest_discs(
    discs: Array, x: float, y: float, heading: float, vx: float, vy: float, count: int
) -> Array:
    """The nearest discs as seen from a frame, the nearest first.

    Args:
        discs: Centre and radius of each, m, shape (n, 3).
        x: Of the frame's origin, m.
        y: Likewise.
        heading: Of its x axis, rad.
        vx: Velocity of its origin, m/s.
        vy: Likewise.
        count: How many; where there are fewer, the rest is far away.

    Returns:
        Shape (4 * count,), in [-1, 1]: of each the direction of its centre ahead and to the left (a unit vector), its
        clearance from the origin (1 m is 0.5) and the speed at which the origin closes in (1 m/s is 0.5).
    """
    seen = np.zeros(NUMBERS * count)
    ahead_x, ahead_y = math.cos(heading), math.sin(heading)
    taken = np.zeros(len(discs), dtype=np.bool_)
    for place in range(count):
        best, least = -1, math.inf
        for i in range(len(discs)):
            clearance = hypot(discs[i, 0] - x, discs[i, 1] - y) - discs[i, 2]
            if not taken[i] and clearance < least:
                best, least = i, clearance
        seen[NUMBERS * place + 2] = 1.0
        if best < 0:
            continue
        taken[best] = True
        to_x, to_y = discs[best, 0] - x, discs[best, 1] - y
        distance = hypot(to_x, to_y)
        if distance > 0.0:
            to_x, to_y = to_x / distance, to_y / distance
        seen[NUMBERS * place] = to_x * ahead_x + to_y * ahead_y
        seen[NUMBERS * place + 1] = to_y * ahead_x - to_x * ahead_y
        seen[NUMBERS * place + 2] = squashed(least, 1.0)
        seen[NUMBERS * place + 3] = squashed(vx * to_x + vy * to_y, 1.0)
    return seen


def convex_outline(points: Array) -> Array:
    """Corners of the smallest convex outline around points (n, 2), m: counter-clockwise, shape (c, 2), none on edges.

    Raises:
        ConfigurationError: All points lie on one line.
    """
    from scipy.spatial import ConvexHull, QhullError  # here: SciPy takes a while to import

    try:
        return np.asarray(points[ConvexHull(points).vertices], dtype=np.float64)
    except (QhullError, ValueError):
        wanted = "an outline needs three points that are not on one line"
        raise ConfigurationError(f"{wanted}, got {points.tolist()}") from None


@compiled
def distance_to_outline(outline: Array, x: float, y: float) -> float:
    """Signed distance of a point, m, to a convex outline with corners (c, 2) counter-clockwise; negative inside."""
    nearest, deepest, last = math.inf, -math.inf, len(outline) - 1
    for i in range(len(outline)):
        after = i + 1 if i < last else 0
        edge_x, edge_y = outline[after, 0] - outline[i, 0], outline[after, 1] - outline[i, 1]
        length = math.sqrt(edge_x * edge_x + edge_y * edge_y)
        along_x, along_y = edge_x / length, edge_y / length
        offset_x, offset_y = x - outline[i, 0], y - outline[i, 1]
        ahead = offset_x * along_x + offset_y * along_y
        beyond = offset_x * along_y - offset_y * along_x
        past = ahead - min(max(ahead, 0.0), length)
        square = past * past + beyond * beyond
        if square < nearest or square != square:  # what is not a number stays
            nearest = square
        if beyond > deepest or beyond != beyond:
            deepest = beyond
    return deepest if deepest <= 0.0 else math.sqrt(nearest)


@compiled
def clearances_on_a_course(outline: Array, places: Array, ahead: Array, discs: Array) -> Array:
    """What an outline leaves to discs at k instants, m, shape (k, n).

    Args:
        outline: Convex, corners (c, 2) counter-clockwise in the body's frame, m; without corners the origin counts.
        places: Of the body's origin, m, shape (k, 2).
        ahead: The body's x axis, unit vectors, shape (k, 2).
        discs: Centres and radii, m, shape (n, 3).
    """
    left = np.empty((len(places), len(discs)))
    for k in range(len(places)):
        for i in range(len(discs)):
            x, y = discs[i, 0] - places[k, 0], discs[i, 1] - places[k, 1]
            if len(outline):
                along, beside = x * ahead[k, 0] + y * ahead[k, 1], y * ahead[k, 0] - x * ahead[k, 1]
                left[k, i] = distance_to_outline(outline, along, beside) - discs[i, 2]
            else:
                left[k, i] = math.sqrt(x * x + y * y) - discs[i, 2]
    return left


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
