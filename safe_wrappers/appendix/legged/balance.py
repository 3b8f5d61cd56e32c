"""The zero moment point of forces and of motions, and its margin inside the support polygon.

Source: appendix "Physical contact feasibility constraints", third condition. Assumes contacts in one plane that do
not slip.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, finite_array, finite_arrays
from safe_wrappers.control.legged.support import (
    COPLANAR_M,
    COPLANAR_RAD,
    Plane,
    common_plane,
    support_polygon,
)
from safe_wrappers.errors import ConfigurationError


class Balance(NamedTuple):
    """Zero moment point of contact forces, and its margin against tipping.

    Attributes:
        coplanar: Whether the contacts lie in one plane. Where not, `zmp` and `margin` are NaN: the model does not
            hold.
        zmp: Zero moment point, shape (3,), m; NaN without pressure on the plane.
        margin: Its distance from the polygon's edge minus the inset, m; negative outside.
    """

    coplanar: bool
    zmp: Array
    margin: float


def zmp_of_forces(points: ArrayLike, forces: ArrayLike, ground: Plane, moments: ArrayLike = 0.0) -> Array:
    """Where contact wrenches have no tangential moment, on the plane; shape (..., 3), m.

    NaN without pressure on the plane, where it does not exist.

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
    m = finite_array("mass", mass)
    force = m[..., None] * (a - g)
    return _zmp(force, rate + np.cross(c - ground.origin, force), ground)


def _zmp(force: Array, moment: Array, ground: Plane) -> Array:
    """From the sum of forces and their moment about the plane's origin."""
    pressure = force @ ground.normal
    arm = np.cross(ground.normal, moment)
    offset = np.full(arm.shape, np.nan)
    np.divide(arm, pressure[..., None], out=offset, where=pressure[..., None] > 0.0)
    return np.asarray(ground.origin + offset)


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
