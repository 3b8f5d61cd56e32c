"""The zero moment point's distance from the edge of the support polygon, at many instants at once.

No polygon is built. The distance of a point inside a convex hull from its boundary is the least of
`max_k (p_k - x) . u` over directions u across pairs of points; pairs that are no edge give no smaller one.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.checks import Array, finite_arrays
from safe_wrappers.control.legged.support import COPLANAR_M, COPLANAR_RAD
from safe_wrappers.control.numerics.compiled import compiled, hypot
from safe_wrappers.errors import ConfigurationError

_ROUNDING = 1e-12
"""Of the points' extent: a narrower hull is a line."""


def support_distances(
    instant: ArrayLike,
    points: ArrayLike,
    normals: ArrayLike,
    forces: ArrayLike,
    tolerance_m: float = COPLANAR_M,
    tolerance_rad: float = COPLANAR_RAD,
) -> Array:
    """Distances, m, negative outside, where three or more contacts of one plane, not on a line, are pressed.

    One for each of these instants in turn; the others have none.

    Args:
        instant: To which instant each contact belongs, whole numbers, shape (n,); in any order.
        points: Shape (n, 3), m.
        normals: Unit normals, shape (n, 3).
        forces: On the robot, shape (n, 3), N.
        tolerance_m: Largest distance of a point from its instant's plane.
        tolerance_rad: Largest angle between a normal and the mean of its instant.
    """
    p, n, f = finite_arrays(points=points, normals=normals, forces=forces)
    when = np.asarray(instant)
    if p.ndim != 2 or p.shape[1] != 3 or when.shape != p.shape[:1]:
        raise ConfigurationError(f"expected instants (n,) and points (n, 3), got {when.shape} and {p.shape}")
    order = np.argsort(when, kind="stable")
    ends = np.append(np.flatnonzero(np.diff(when[order])) + 1, len(when))
    return _distances(p[order], n[order], f[order], ends, tolerance_m, math.cos(tolerance_rad) - _ROUNDING)


@compiled
def _distances(
    points: Array, normals: Array, forces: Array, ends: NDArray[np.int64], apart: float, facing: float
) -> Array:
    """Of contacts in the order of their instants, which end before these."""
    found, count, first = np.empty(len(ends)), 0, 0
    axes, flat, x = np.empty((3, 3)), np.empty((len(points), 2)), np.empty(2)
    for end in ends:
        these = slice(first, end)
        first = end
        if _on_plane(points[these], normals[these], forces[these], apart, facing, axes, flat, x):
            distance = _from_edges(flat[: end - these.start], x)
            if distance != math.inf:
                found[count] = distance
                count += 1
    return found[:count]


@compiled
def _on_plane(
    points: Array,
    normals: Array,
    forces: Array,
    apart: float,
    facing: float,
    axes: Array,
    flat: Array,
    x: Array,
) -> bool:
    """Write contacts of one plane and their zero moment point in its coordinates; False if there is none.

    `axes` are for the plane's normal and two tangents.
    """
    k, mean = len(points), axes[0]
    if k < 3:
        return False
    origin, moment, pressure = np.zeros(3), np.zeros(3), 0.0
    mean[:] = 0.0
    for i in range(k):
        mean += normals[i]
        origin += points[i]
    length = math.sqrt(_dot(mean, mean))
    if length < 0.5 * k:
        return False
    mean /= length
    origin /= k
    for i in range(k):
        arm, force = points[i] - origin, forces[i]
        if abs(_dot(arm, mean)) > apart or _dot(normals[i], mean) < facing:
            return False
        pressure += _dot(force, mean)
        moment += _cross(arm, force)
    if not pressure > 0.0:
        return False
    axes[1] = 0.0
    axes[1, np.argmin(np.abs(mean))] = 1.0  # the axis of the world that is farthest from the normal
    axes[1] -= _dot(axes[1], mean) * mean
    axes[1] /= math.sqrt(_dot(axes[1], axes[1]))
    axes[2] = _cross(mean, axes[1])
    zmp = _cross(mean, moment) / pressure
    for axis in range(2):
        x[axis] = _dot(zmp, axes[1 + axis])
        for i in range(k):
            flat[i, axis] = _dot(points[i] - origin, axes[1 + axis])
    return True


@compiled
def _from_edges(points: Array, x: Array) -> float:
    """Of one point (2,) among others (k, 2); infinite where these are on a line, NaN where it is not finite."""
    if not (math.isfinite(x[0]) and math.isfinite(x[1])):
        return math.nan
    width, longest, inside, outside = math.inf, 0.0, math.inf, math.inf
    for i in range(len(points)):
        for j in range(i + 1, len(points)):
            along_x, along_y = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
            length = hypot(along_x, along_y)
            to_x, to_y, share = x[0] - points[i, 0], x[1] - points[i, 1], 0.0
            if length > 0.0:
                across_x, across_y = -along_y / length, along_x / length
                low, high = math.inf, -math.inf
                for other in points:
                    side = across_x * other[0] + across_y * other[1]
                    low, high = min(low, side), max(high, side)
                level = across_x * x[0] + across_y * x[1]
                width, longest = min(width, high - low), max(longest, length)
                inside = min(inside, high - level, level - low)
                # Outside, the nearest point of the hull is on one of the lines between two points.
                share = min(max((to_x * along_x + to_y * along_y) / length**2, 0.0), 1.0)
            outside = min(outside, hypot(to_x - share * along_x, to_y - share * along_y))
    if longest == 0.0 or width <= _ROUNDING * longest:
        return math.inf
    return inside if inside >= 0.0 else -outside


@compiled
def _dot(a: Array, b: Array) -> float:
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@compiled
def _cross(a: Array, b: Array) -> Array:
    x, y, z = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    return np.array([x, y, z])
