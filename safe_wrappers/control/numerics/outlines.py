"""Convex hulls of points in the plane, and signed distances from them."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
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


def distances_to_outline(outline: Array, points: Array) -> Array:
    """Signed distances (...), m, of points (..., 2) to a convex outline with corners (c, 2) counter-clockwise."""
    edges = np.roll(outline, -1, axis=0) - outline
    lengths = np.sqrt((edges**2).sum(axis=1))
    along = edges / lengths[:, None]
    offsets = points[..., None, :] - outline
    ahead = (offsets * along).sum(axis=-1)
    beyond = offsets[..., 0] * along[:, 1] - offsets[..., 1] * along[:, 0]
    past = ahead - np.minimum(np.maximum(ahead, 0.0), lengths)
    outside = np.sqrt((past**2 + beyond**2).min(axis=-1))
    deepest = beyond.max(axis=-1)
    return np.asarray(np.where(deepest <= 0.0, deepest, outside))
