"""Zero moment point and support polygon: whether coplanar contacts can hold a robot up without tipping.

Source: appendix "Physical contact feasibility constraints", third condition. The zero moment point is where, on the
plane of support, the contact forces have no tangential moment. Forces that push at points of the plane keep it
inside the convex hull of these points: the support polygon. An inset keeps a distance from its edges.

It holds for the model it names: contacts in one plane, that do not slip. Contacts at several heights need the
general question whether the wrench is feasible (`whole_body`); here they are flagged, `coplanar` False, and get no
number. And crossing an edge predicts no particular fall: a robot may step, or tip about an edge and come back.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.control.contact.friction_cone import tangents
from safe_wrappers.control.numerics.finite import finite_arrays
from safe_wrappers.errors import ConfigurationError

Array = NDArray[np.float64]

COPLANAR_M = 0.01
"""m; contacts farther than this from one plane are not called coplanar unless the caller says otherwise."""
COPLANAR_RAD = 0.05
"""rad; the same for the directions of their normals."""
_ROUNDING = 1e-12


class Plane(NamedTuple):
    """A plane of support.

    Attributes:
        origin: A point on it, shape (3,), m.
        normal: Unit normal, pointing at the robot, shape (3,).
        axes: Two unit tangents, shape (2, 3), right-handed with the normal.
    """

    origin: Array
    normal: Array
    axes: Array

    def flat(self, points: ArrayLike) -> Array:
        """Coordinates in the plane of points of the world (..., 3), projected onto it: shape (..., 2), m."""
        (p,) = finite_arrays(points=points)
        return np.asarray((p - self.origin) @ self.axes.T)


class Balance(NamedTuple):
    """Whether contact forces are clear of tipping.

    Attributes:
        coplanar: Whether the contacts lie in one plane. Where not, `zmp` and `margin` are NaN: the model does not
            hold, whatever its number would be.
        zmp: Zero moment point, shape (3,), m; NaN where nothing presses on the plane.
        margin: Its distance from the polygon's edge minus the inset, m; negative outside.
    """

    coplanar: bool
    zmp: Array
    margin: float


def plane(origin: ArrayLike, normal: ArrayLike) -> Plane:
    """The plane through a point with a unit normal."""
    o, n = finite_arrays(origin=origin, normal=normal)
    return Plane(o, n, tangents(n))


def common_plane(
    points: ArrayLike,
    normals: ArrayLike,
    tolerance_m: float = COPLANAR_M,
    tolerance_rad: float = COPLANAR_RAD,
) -> Plane | None:
    """The plane that contacts share, or None: they are at several heights, or face different ways.

    Args:
        points: Shape (k, 3), m.
        normals: Unit normals, shape (k, 3).
        tolerance_m: Largest distance of a point from the plane.
        tolerance_rad: Largest angle between a normal and their mean.
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
    level = bool((np.abs((p - origin) @ mean) <= tolerance_m).all())
    facing = bool((n @ mean >= np.cos(tolerance_rad) - 1e-12).all())
    return plane(origin, mean) if level and facing else None


def zmp_of_forces(points: ArrayLike, forces: ArrayLike, ground: Plane, moments: ArrayLike = 0.0) -> Array:
    """Where contact wrenches have no tangential moment, on the plane; shape (..., 3), m.

    NaN where nothing presses on the plane: then there is no such point.

    Args:
        points: Shape (..., k, 3), m.
        forces: On the robot, shape (..., k, 3), N.
        ground: The plane.
        moments: On the robot, about its contact point, shape (..., k, 3), N m.
    """
    p, f, t = finite_arrays(points=points, forces=forces, moments=moments)
    return _zmp(f.sum(axis=-2), (np.cross(p - ground.origin, f) + t).sum(axis=-2), ground)


def zmp_of_motion(
    mass: ArrayLike,
    com: ArrayLike,
    com_acceleration: ArrayLike,
    angular_rate: ArrayLike,
    gravity: ArrayLike,
    ground: Plane,
) -> Array:
    """Where the contact wrench that a motion needs has no tangential moment, on the plane; shape (..., 3), m.

    The same point as `zmp_of_forces`, if these forces make that motion. NaN where the motion needs no pressure.

    Args:
        mass: Shape (...), kg.
        com: Centre of mass, shape (..., 3), m.
        com_acceleration: Shape (..., 3), m/s^2.
        angular_rate: Rate of the angular momentum about the centre of mass, shape (..., 3), N m.
        gravity: Acceleration, shape (..., 3), m/s^2.
        ground: The plane.
    """
    c, a, rate, g = finite_arrays(
        com=com, com_acceleration=com_acceleration, angular_rate=angular_rate, gravity=gravity
    )
    (m,) = finite_arrays(mass=mass)
    force = m[..., None] * (a - g)
    return _zmp(force, rate + np.cross(c - ground.origin, force), ground)


def _zmp(force: Array, moment: Array, ground: Plane) -> Array:
    """From the sum of forces and their moment about the plane's origin."""
    pressure = force @ ground.normal
    arm = np.cross(ground.normal, moment)
    offset = np.full(arm.shape, np.nan)
    np.divide(arm, pressure[..., None], out=offset, where=pressure[..., None] > 0.0)
    return np.asarray(ground.origin + offset)


def support_polygon(points: ArrayLike) -> Array:
    """Corners of the convex hull of points in a plane, anticlockwise, shape (v, 2).

    Points on its edges are left out. Two corners are a line of support, one is a point.

    Args:
        points: Shape (k, 2), m, k >= 1.
    """
    (given,) = finite_arrays(points=points)
    if given.ndim != 2 or given.shape[1] != 2 or not len(given):
        raise ConfigurationError(f"points must have shape (k, 2) with at least one point, got {given.shape}")
    ordered = np.unique(given, axis=0)  # sorted by x, then y
    if len(ordered) < 3:
        return ordered

    def half(chain: list[Array]) -> list[Array]:
        kept: list[Array] = []
        for point in chain:
            while len(kept) > 1 and _turn(kept[-2], kept[-1], point) <= 0.0:
                kept.pop()
            kept.append(point)
        return kept[:-1]

    chain = list(ordered)
    corners = half(chain) + half(chain[::-1])
    # What stands out by no more than rounding is a point on an edge.
    least = _ROUNDING * float(np.ptp(ordered, axis=0).max())
    i = 0
    while i < len(corners) > 2:
        before, after = corners[i - 1], corners[(i + 1) % len(corners)]
        if _turn(before, corners[i], after) <= least * math.dist(before, after):
            del corners[i]
        else:
            i += 1
    return np.array(corners)


def support_margin(point: ArrayLike, polygon: ArrayLike, inset: float = 0.0) -> float:
    """Distance of a point of the plane from the polygon's edge minus the inset, m; negative outside.

    Outside it is the distance to the nearest point of the polygon. A line or a point of support has no inside: the
    margin is at most minus the inset.

    Args:
        point: Shape (2,), m; not a number gives not a number.
        polygon: Corners as `support_polygon` gives them, shape (v, 2).
        inset: m, at least 0.
    """
    x, corners = np.asarray(point, dtype=np.float64), np.asarray(polygon, dtype=np.float64)
    if x.shape != (2,) or corners.ndim != 2 or corners.shape[1] != 2 or not len(corners):
        raise ConfigurationError(
            f"expected a point (2,) and corners (v, 2), got {x.shape} and {corners.shape}"
        )
    if not (np.isfinite(inset) and inset >= 0.0):
        raise ConfigurationError(f"inset must be 0 m or more, got {inset}")
    if not np.isfinite(x).all():
        return float("nan")
    edges = np.roll(corners, -1, axis=0) - corners
    to = x - corners
    if len(corners) > 2:
        inward = np.stack([-edges[:, 1], edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1)[:, None]
        inside = float((inward * to).sum(axis=1).min())
        if inside >= 0.0:
            return inside - inset
    square = (edges * edges).sum(axis=1)
    along = np.divide((to * edges).sum(axis=1), square, out=np.zeros(len(square)), where=square > 0.0)
    nearest = to - np.clip(along, 0.0, 1.0)[:, None] * edges
    return -float(np.linalg.norm(nearest, axis=1).min()) - inset


def balance(
    points: ArrayLike,
    normals: ArrayLike,
    forces: ArrayLike,
    inset: float = 0.0,
    tolerance_m: float = COPLANAR_M,
    tolerance_rad: float = COPLANAR_RAD,
) -> Balance:
    """Zero moment point and margin of contacts, where the model holds.

    Args:
        points: Shape (k, 3), m; the support polygon is their convex hull.
        normals: Unit normals, shape (k, 3).
        forces: On the robot, shape (k, 3), N.
        inset: m.
        tolerance_m: See `common_plane`.
        tolerance_rad: See `common_plane`.
    """
    ground = common_plane(points, normals, tolerance_m, tolerance_rad)
    if ground is None:
        return Balance(False, np.full(3, np.nan), float("nan"))
    zmp = zmp_of_forces(points, forces, ground)
    polygon = support_polygon(ground.flat(points))
    flat = ground.axes @ (zmp - ground.origin)
    return Balance(True, zmp, support_margin(flat, polygon, inset))


def support_rows(points: ArrayLike, ground: Plane, inset: float) -> Array:
    """The inset as half-spaces on the stacked contact forces: `rows @ forces.ravel() <= 0`, shape (v, 3 k).

    For each edge: pressure counts for the distance of its point from the inset edge. Together with forces that push,
    the rows hold where the zero moment point is inside the inset polygon or nothing presses. Contacts on a line or at
    a point, and an inset that leaves nothing of the polygon, allow no pressure at all.

    Args:
        points: In the plane, shape (k, 3), m.
        ground: The plane.
        inset: m, at least 0.
    """
    flat = ground.flat(points)
    corners = support_polygon(flat)
    if not (np.isfinite(inset) and inset >= 0.0):
        raise ConfigurationError(f"inset must be 0 m or more, got {inset}")
    if len(corners) < 3:
        weights = np.full((1, len(flat)), -inset)
    else:
        edges = np.roll(corners, -1, axis=0) - corners
        inward = np.stack([-edges[:, 1], edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1)[:, None]
        weights = inward @ flat.T - (inward * corners).sum(axis=1)[:, None] - inset
    return np.asarray((-weights[:, :, None] * ground.normal).reshape(len(weights), -1))


def _turn(a: Array, b: Array, c: Array) -> float:
    """Twice the area of a triangle, m^2; positive anticlockwise."""
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))
