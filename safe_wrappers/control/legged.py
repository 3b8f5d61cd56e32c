"""Support of contacts: the zero moment point in its polygon; centroidal momentum.

Source: appendix "Centroidal momentum dynamics" and "Physical contact feasibility constraints", third condition. The
zero moment point is where, on the plane of support, the contact forces have no tangential moment. Forces that push
keep it inside the support polygon, the convex hull of their points; an inset keeps a distance from its edges.

It assumes contacts in one plane that do not slip; contacts at several heights need `whole_body`. Distances from the
polygon's edge need no polygon: the distance of a point inside a convex hull from its boundary is the least of
`max_k (p_k - x) . u` over directions u across pairs of points; pairs that are no edge give no smaller one.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.control.compiled import compiled, hypot
from safe_wrappers.errors import Array

COPLANAR_M = 0.01
"""m; the largest distance of coplanar contacts from their plane."""
_ROUNDING = 1e-12
"""Of an angle's cosine, and of the points' extent: a narrower hull is a line."""
_FACING = math.cos(0.05) - _ROUNDING
"""The cosine of the largest angle between their normals and the mean."""


def support_distances(instant: NDArray[np.intp], points: Array, normals: Array, forces: Array) -> Array:
    """Distances, m, negative outside, where three or more contacts of one plane, not on a line, are pressed.

    One for each of these instants in turn; the others have none. Contacts are given by the number of their instant,
    shape (n,), in any order, their points, m, unit normals and forces on the robot, N, shape (n, 3) each.
    """
    order = np.argsort(instant, kind="stable")
    each = np.split(order, np.flatnonzero(np.diff(instant[order])) + 1)
    found = np.array([_distance(points[these], normals[these], forces[these]) for these in each])
    return np.asarray(found[found != math.inf])


@compiled
def _distance(points: Array, normals: Array, forces: Array) -> float:
    """Of the contacts of one instant; infinite where there is no polygon, or nothing presses."""
    k, mean = len(points), _total(normals)
    length = math.sqrt(_dot(mean, mean))
    if k < 3 or length < 0.5 * k:
        return math.inf
    mean /= length
    origin, force, moment = _total(points) / k, _total(forces), np.zeros(3)
    for i in range(k):
        arm = points[i] - origin
        if abs(_dot(arm, mean)) > COPLANAR_M or _dot(normals[i], mean) < _FACING:
            return math.inf
        moment += _cross(arm, forces[i])
    pressure = _dot(force, mean)
    if not pressure > 0.0:
        return math.inf
    first = np.zeros(3)
    first[np.argmin(np.abs(mean))] = 1.0  # the axis of the world that is farthest from the normal
    first -= _dot(first, mean) * mean
    first /= math.sqrt(_dot(first, first))
    zmp, second, flat = _cross(mean, moment) / pressure, _cross(mean, first), np.empty((k, 2))
    for i in range(k):
        flat[i, 0], flat[i, 1] = _dot(points[i] - origin, first), _dot(points[i] - origin, second)
    return _from_edges(flat, np.array([_dot(zmp, first), _dot(zmp, second)]))


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
def _total(rows: Array) -> Array:
    total = np.zeros(3)
    for row in rows:
        total += row
    return total


@compiled
def _dot(a: Array, b: Array) -> float:
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@compiled
def _cross(a: Array, b: Array) -> Array:
    x, y, z = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    return np.array([x, y, z])


class CentroidalMomentum(NamedTuple):
    """Momentum: `linear`, kg m/s, and `angular` about the centre of mass, kg m^2/s, shape (3,) each."""

    mass: float  # kg
    com: Array  # centre of mass, shape (3,), m
    linear: Array
    angular: Array


def centroidal_momentum(
    masses: Array, positions: Array, velocities: Array, angular_momenta: Array
) -> CentroidalMomentum:
    """Of n parts together: masses (n,), kg, their centres, m, velocities, m/s, and angular momenta about these."""
    total = float(masses.sum())
    com, momenta = masses @ positions / total, masses[:, None] * velocities
    # Relative to the centre of mass; the velocities need no such shift, since sum m (p - c) = 0.
    angular = (np.cross(positions - com, momenta) + angular_momenta).sum(axis=0)
    return CentroidalMomentum(total, com, momenta.sum(axis=0), angular)
