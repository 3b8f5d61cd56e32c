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

from safe_wrappers.control.contact import tangents
from safe_wrappers.errors import Array

COPLANAR_M = 0.01
"""m; the largest distance of coplanar contacts from their plane."""
_ROUNDING = 1e-12
"""Of an angle's cosine, and of the points' extent: a narrower hull is a line."""
_FACING = math.cos(0.05) - _ROUNDING
"""The cosine of the largest angle between their normals and the mean."""


def support_distances(instant: NDArray[np.intp], points: Array, normals: Array, forces: Array) -> Array:
    """Distances, m, negative outside, where three or more contacts of one plane, not on a line, are pressed.

    One for each of these instants, in any order; the others have none. Contacts are given by the number of their
    instant, shape (n,), their points, m, unit normals and forces on the robot, N, shape (n, 3) each.
    """
    _, which, counts = np.unique(instant, return_inverse=True, return_counts=True)
    order, found = np.argsort(which, kind="stable"), [np.zeros(0)]
    for count in set(counts[counts > 2].tolist()):  # instants of as many contacts together
        chosen = order[counts[which[order]] == count].reshape(-1, count)
        found.append(_distances(points[chosen], normals[chosen], forces[chosen]))
    return np.concatenate(found)


def _distances(points: Array, normals: Array, forces: Array) -> Array:
    """Of instants with k contacts each, shapes (n, k, 3), where there is a polygon and something presses."""
    total, arms = normals.sum(axis=1), points - points.mean(axis=1, keepdims=True)
    length = np.linalg.norm(total, axis=1)
    mean = total / np.maximum(length, 0.5 * points.shape[1])[:, None]
    pressure = np.einsum("ni,ni->n", forces.sum(axis=1), mean)
    level = np.abs(np.einsum("nki,ni->nk", arms, mean)) <= COPLANAR_M
    facing = np.einsum("nki,ni->nk", normals, mean) >= _FACING
    there = level.all(axis=1) & facing.all(axis=1) & (pressure > 0.0)
    mean, arms = mean[there], arms[there]
    moment = np.cross(arms, forces[there]).sum(axis=1)
    across = tangents(mean)
    zmp = np.einsum("ni,nai->na", np.cross(mean, moment) / pressure[there, None], across)
    return _from_edges(np.einsum("nki,nai->nka", arms, across), zmp)


def _from_edges(points: Array, x: Array) -> Array:
    """Distances of points (n, 2) from the edges of the hulls of others (n, k, 2), but of those on a line."""
    one, other = np.triu_indices(points.shape[1], 1)
    start = points[:, one]
    along = points[:, other] - start
    length = np.linalg.norm(along, axis=2)
    same = length == 0.0
    along = along / np.where(same, 1.0, length)[:, :, None]
    across = np.stack([-along[:, :, 1], along[:, :, 0]], axis=2)
    sides = across @ points.swapaxes(1, 2)
    low, high, level = sides.min(axis=2), sides.max(axis=2), np.einsum("npa,na->np", across, x)
    inside = np.where(same, np.inf, np.minimum(high - level, level - low)).min(axis=1)
    # Outside, the nearest point of the hull is on one of the lines between two points.
    to = x[:, None] - start
    share = np.clip(np.einsum("npa,npa->np", to, along), 0.0, length)
    outside = np.linalg.norm(to - share[:, :, None] * along, axis=2).min(axis=1)
    wide = np.where(same, np.inf, high - low).min(axis=1) > _ROUNDING * length.max(axis=1)
    return np.asarray(np.where(inside >= 0.0, inside, -outside)[wide & ~same.all(axis=1)])


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
