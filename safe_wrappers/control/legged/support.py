"""Support plane and support polygon of contacts, and the inset as rows on contact forces.

Source: appendix "Physical contact feasibility constraints", third condition. The zero moment point is where, on the
plane of support, the contact forces have no tangential moment. Forces that push keep it inside the support polygon,
the convex hull of their points; an inset keeps a distance from its edges.

It assumes contacts in one plane that do not slip; contacts at several heights need `whole_body`.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, finite_array, finite_arrays, non_negative
from safe_wrappers.control.contact.friction_cone import tangents
from safe_wrappers.control.numerics.outlines import convex_chain, turn
from safe_wrappers.errors import ConfigurationError

COPLANAR_M = 0.01
"""m; default of the largest distance of coplanar contacts from their plane."""
COPLANAR_RAD = 0.05
"""rad; default of the largest angle between their normals and the mean."""
_ROUNDING = 1e-12


class Plane(NamedTuple):
    """A point of a plane of support (3,), m, its unit normal (3,) towards the robot, two unit tangents (2, 3)."""

    origin: Array
    normal: Array
    axes: Array

    def flat(self, points: ArrayLike) -> Array:
        """Coordinates in the plane of points of the world (..., 3), projected onto it: shape (..., 2), m."""
        p = finite_array("points", points)
        return np.asarray((p - self.origin) @ self.axes.T)


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
    """The plane of coplanar contacts, or None where they are at several heights or face different ways.

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


def support_polygon(points: ArrayLike) -> Array:
    """Corners of the convex hull of points in a plane, shape (k, 2), m, k >= 1: anticlockwise, shape (v, 2).

    Points on its edges are left out. Two corners are a line of support, one is a point.
    """
    given = finite_array("points", points)
    if given.ndim != 2 or given.shape[1] != 2 or not len(given):
        raise ConfigurationError(f"points must have shape (k, 2) with at least one point, got {given.shape}")
    ordered = sorted(set(map(tuple, given.tolist())))
    if len(ordered) < 3:
        return np.array(ordered)
    corners = convex_chain(ordered) + convex_chain(ordered[::-1])
    # A corner that protrudes by no more than rounding is a point on an edge.
    least = _ROUNDING * float(np.ptp(given, axis=0).max())
    i = 0
    while i < len(corners) > 2:
        before, after = corners[i - 1], corners[(i + 1) % len(corners)]
        if turn(before, corners[i], after) <= least * math.dist(before, after):
            del corners[i]
        else:
            i += 1
    return np.array(corners)


def support_rows(points: ArrayLike, ground: Plane, inset: float) -> Array:
    """The inset as half-spaces on the stacked contact forces: `rows @ forces.ravel() <= 0`, shape (v, 3 k).

    Together with forces that push, the rows hold where the zero moment point is inside the inset polygon or nothing
    presses. Contacts on a line, and an inset that leaves nothing of the polygon, allow no pressure at all.

    Args:
        points: In the plane, shape (k, 3), m.
        ground: The plane.
        inset: m, at least 0.
    """
    flat = ground.flat(points)
    corners = support_polygon(flat)
    non_negative("inset", inset, "m")
    if len(corners) < 3:
        weights = np.full((1, len(flat)), -inset)
    else:
        edges = np.roll(corners, -1, axis=0) - corners
        inward = np.stack([-edges[:, 1], edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1)[:, None]
        weights = inward @ flat.T - (inward * corners).sum(axis=1)[:, None] - inset
    return np.asarray((-weights[:, :, None] * ground.normal).reshape(len(weights), -1))
