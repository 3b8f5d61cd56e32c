"""The zero moment point's distance from the edge of the support polygon, at many instants at once.

The same numbers as `safe_wrappers.appendix.legged.balance` gives instant by instant, without building polygons. The
distance of a point inside a convex hull from its boundary is the least of `max_k (p_k - x) . u` over directions u
across pairs of points; pairs that are no edge give no smaller one.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.checks import finite_arrays
from safe_wrappers.control.contact.friction_cone import tangents
from safe_wrappers.control.legged.support import COPLANAR_M, COPLANAR_RAD
from safe_wrappers.errors import ConfigurationError

Array = NDArray[np.float64]

_ROUNDING = 1e-12
"""Of the points' extent: a narrower hull is a line."""
_PRODUCTS = 2_000_000
"""Largest number of products of pairs and points in memory at once."""


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
    _, index, count = np.unique(when, return_inverse=True, return_counts=True)
    enough = np.flatnonzero(count >= 3)
    if not enough.size:
        return np.zeros(0)
    # Instants as rows, their contacts as columns; a shorter row ends in copies of its first contact.
    order, most = np.argsort(index, kind="stable"), int(count.max())
    column = np.arange(most)
    first = (np.cumsum(count) - count)[enough, None]
    real = column < count[enough, None]
    which = order[first + np.where(real, column, 0)]
    rows = max(1, _PRODUCTS // most**3)
    facing = float(np.cos(tolerance_rad))
    blocks = [(which[i : i + rows], real[i : i + rows, :, None]) for i in range(0, len(which), rows)]
    return np.concatenate([_of_rows(p[i], n[i], f[i], kept, tolerance_m, facing) for i, kept in blocks])


def _of_rows(p: Array, n: Array, f: Array, real: NDArray[np.bool_], apart: float, facing: float) -> Array:
    """Points, normals and forces of shape (rows, k, 3), the real ones among them of shape (rows, k, 1)."""
    mean = (n * real).sum(axis=1)
    length = np.linalg.norm(mean, axis=1)
    upright = length >= 0.5 * real.sum(axis=(1, 2))
    p, n, f, real, mean = p[upright], n[upright], f[upright], real[upright], mean[upright]
    mean /= length[upright, None]
    p = p - (p * real).sum(axis=1, keepdims=True) / real.sum(axis=1, keepdims=True)
    height = np.einsum("rki,ri->rk", p, mean)
    cosine = np.einsum("rki,ri->rk", n, mean)
    f = f * real
    pressure = np.einsum("rki,ri->r", f, mean)
    fits = (np.abs(height) <= apart).all(axis=1) & (cosine >= facing - _ROUNDING).all(axis=1)
    fits &= pressure > 0.0
    p, f, mean = p[fits], f[fits], mean[fits]
    axes = tangents(mean)
    moment = np.cross(p, f).sum(axis=1)
    zmp = np.cross(mean, moment) / pressure[fits, None]
    return _from_edges(np.einsum("rki,rai->rka", p, axes), np.einsum("ri,rai->ra", zmp, axes))


def _from_edges(points: Array, x: Array) -> Array:
    """Points (rows, k, 2) and one point (rows, 2) each; rows whose points are on a line are left out."""
    one, other = np.triu_indices(points.shape[1], 1)
    along = points[:, other] - points[:, one]
    length = np.linalg.norm(along, axis=2)
    apart = length > 0.0
    across = np.stack([-along[..., 1], along[..., 0]], axis=2)
    np.divide(across, length[..., None], out=across, where=apart[..., None])
    sides = across @ points.transpose(0, 2, 1)
    high, low = sides.max(axis=2), sides.min(axis=2)
    width = np.where(apart, high - low, np.inf).min(axis=1)
    level = np.einsum("rpa,ra->rp", across, x)
    inside = np.where(apart, np.minimum(high - level, level - low), np.inf).min(axis=1)
    # Outside, the nearest point of the hull is on one of the lines between two points.
    to = x[:, None] - points[:, one]
    share = np.divide((to * along).sum(axis=2), length**2, out=np.zeros_like(length), where=apart)
    outside = np.linalg.norm(to - np.clip(share, 0.0, 1.0)[..., None] * along, axis=2).min(axis=1)
    polygon = apart.any(axis=1) & (width > _ROUNDING * length.max(axis=1))
    return np.asarray(np.where(inside >= 0.0, inside, -outside)[polygon])
