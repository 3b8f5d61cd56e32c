"""Convex hulls of points in the plane, and signed distances from them."""

import math

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.control.numerics.compiled import compiled

Point = tuple[float, float]


def convex_outline(points: Array) -> Array:
    """Corners of the smallest convex outline around points (n, 2), m: counter-clockwise, shape (c, 2), none on edges.

    Raises:
        ValueError: All points lie on one line.
    """
    ordered = sorted({(float(x), float(y)) for x, y in points})
    corners = convex_chain(ordered) + convex_chain(ordered[::-1])
    if len(corners) < 3:
        raise ValueError(f"an outline needs three points that are not on one line, got {points.tolist()}")
    return np.array(corners)


def convex_chain(ordered: list[Point]) -> list[Point]:
    """Corners of one side of the convex hull of sorted points, without the last one."""
    chain: list[Point] = []
    for point in ordered:
        while len(chain) >= 2 and turn(chain[-2], chain[-1], point) <= 0.0:
            chain.pop()
        chain.append(point)
    return chain[:-1]


def turn(a: Point, b: Point, c: Point) -> float:
    """Twice the area of a triangle; positive counter-clockwise."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


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
