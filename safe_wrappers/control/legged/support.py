"""Support of contacts: its plane, the zero moment point in its polygon, an inset as rows; centroidal momentum.

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
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.checks import Array, finite_array, finite_arrays, non_negative
from safe_wrappers.control.contact.friction_cone import tangents
from safe_wrappers.control.numerics.compiled import compiled, hypot
from safe_wrappers.errors import ConfigurationError

COPLANAR_M = 0.01
"""m; the largest distance of coplanar contacts from their plane."""
COPLANAR_RAD = 0.05
"""rad; the largest angle between their normals and the mean."""
_ROUNDING = 1e-12
"""Of an angle's cosine, and of the points' extent: a narrower hull is a line."""


class Plane(NamedTuple):
    """A point of a plane of support (3,), m, its unit normal (3,) towards the robot, two unit tangents (2, 3)."""

    origin: Array
    normal: Array
    axes: Array

    def flat(self, points: ArrayLike) -> Array:
        """Coordinates in the plane of points of the world (..., 3), projected onto it: shape (..., 2), m."""
        p = finite_array("points", points)
        return np.asarray((p - self.origin) @ self.axes.T)


def common_plane(points: ArrayLike, normals: ArrayLike) -> Plane | None:
    """The plane of coplanar contacts, or None where they are at several heights or face different ways.

    Args:
        points: Shape (k, 3), m.
        normals: Unit normals, shape (k, 3).
    """
    p, n = finite_arrays(points=points, normals=normals)
    if p.ndim != 2 or p.shape[1] != 3:
        raise ConfigurationError(f"points and normals must have shape (k, 3), got {p.shape}")
    mean = n.sum(axis=0)
    length = float(np.linalg.norm(mean))
    if not len(p) or length < 0.5 * len(p):
        return None
    mean = mean / length
    origin = p.mean(axis=0)
    level = bool((np.abs((p - origin) @ mean) <= COPLANAR_M).all())
    facing = bool((n @ mean >= np.cos(COPLANAR_RAD) - _ROUNDING).all())
    return Plane(origin, mean, tangents(mean)) if level and facing else None


def support_rows(points: ArrayLike, ground: Plane, inset: float) -> Array | None:
    """The inset as half-spaces on the stacked contact forces: `rows @ forces.ravel() <= 0`, shape (v, 3 k).

    Together with forces that push, the rows hold where the zero moment point is inside the inset polygon or nothing
    presses. An inset that leaves nothing of the polygon allows no pressure at all. None: the contacts are on a line.

    Args:
        points: In the plane, shape (k, 3), m.
        ground: The plane.
        inset: m, at least 0.
    """
    from scipy.spatial import ConvexHull, QhullError  # here: SciPy takes a while to import

    flat = ground.flat(points)
    non_negative("inset", inset, "m")
    try:
        outward = ConvexHull(flat).equations
    except (QhullError, ValueError):
        return None
    weights = -(outward[:, :2] @ flat.T + outward[:, 2:]) - inset
    return np.asarray((-weights[:, :, None] * ground.normal).reshape(len(weights), -1))


def support_distances(instant: ArrayLike, points: ArrayLike, normals: ArrayLike, forces: ArrayLike) -> Array:
    """Distances, m, negative outside, where three or more contacts of one plane, not on a line, are pressed.

    One for each of these instants in turn; the others have none.

    Args:
        instant: To which instant each contact belongs, whole numbers, shape (n,); in any order.
        points: Shape (n, 3), m.
        normals: Unit normals, shape (n, 3).
        forces: On the robot, shape (n, 3), N.
    """
    p, n, f = finite_arrays(points=points, normals=normals, forces=forces)
    when = np.asarray(instant)
    if p.ndim != 2 or p.shape[1] != 3 or when.shape != p.shape[:1]:
        raise ConfigurationError(f"expected instants (n,) and points (n, 3), got {when.shape} and {p.shape}")
    order = np.argsort(when, kind="stable")
    ends = np.append(np.flatnonzero(np.diff(when[order])) + 1, len(when))
    return _distances(p[order], n[order], f[order], ends, COPLANAR_M, math.cos(COPLANAR_RAD) - _ROUNDING)


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


class CentroidalMomentum(NamedTuple):
    """Momentum: `linear`, kg m/s, and `angular` about the centre of mass, kg m^2/s, shape (3,) each."""

    mass: float  # kg
    com: Array  # centre of mass, shape (3,), m
    linear: Array
    angular: Array


def centroidal_momentum(
    masses: Array, positions: Array, velocities: Array, angular_momenta: Array
) -> CentroidalMomentum:
    """Of n parts together.

    Args:
        masses: Shape (n,), kg, their sum positive.
        positions: Of the parts' own centres of mass, shape (n, 3), m.
        velocities: Of the same points, shape (n, 3), m/s.
        angular_momenta: Of the parts about them, shape (n, 3), kg m^2/s.
    """
    total = float(masses.sum())
    com, momenta = masses @ positions / total, masses[:, None] * velocities
    # Relative to the centre of mass; the velocities need no such shift, since sum m (p - c) = 0.
    angular = (np.cross(positions - com, momenta) + angular_momenta).sum(axis=0)
    return CentroidalMomentum(total, com, momenta.sum(axis=0), angular)
