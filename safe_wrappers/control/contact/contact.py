"""Unilateral contact: gap, force, and by how much they miss complementarity.

Source: appendix "Rigid Body Contact Mechanics". An ideal contact only pushes, and only when closed:

    gap >= 0,    force >= 0,    gap * force = 0.

Contacts that give way, MuJoCo's among them, miss this by design: their force comes from a penetration (or from a
margin before the touch). The residuals say by how much; that they are small does not make a simulation true.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.control.numerics.finite import finite_arrays
from safe_wrappers.errors import ConfigurationError

Array = NDArray[np.float64]


class ComplementarityResiduals(NamedTuple):
    """By how much contacts miss the three conditions, each shape (...), 0 where they hold.

    Attributes:
        penetration: Depth, m.
        tension: Pull, N.
        product: ``|gap * force|``, N m.
    """

    penetration: Array
    tension: Array
    product: Array


def complementarity_residuals(gap: ArrayLike, force: ArrayLike) -> ComplementarityResiduals:
    """The residuals of contacts, one by one.

    Args:
        gap: Signed distance, m, shape (...): negative where the bodies penetrate.
        force: Normal force, N, shape (...): positive pushes the bodies apart.
    """
    g, f = finite_arrays(gap=gap, force=force)
    return ComplementarityResiduals(np.maximum(-g, 0.0), np.maximum(-f, 0.0), np.abs(g * f))


def sphere_gap(center: ArrayLike, other: ArrayLike, radii: ArrayLike) -> Array:
    """Signed distance of two spheres, shape (...), m.

    Args:
        center: Shape (..., 3) (or (..., 2): discs), m.
        other: The other's, m.
        radii: Sum of both radii, at least 0, shape (...), m. A point has none.
    """
    a, b = finite_arrays(center=center, other=other)
    (r,) = finite_arrays(radii=radii)
    if a.ndim == 0:
        raise ConfigurationError("center must have shape (..., d), got a number")
    if not (r >= 0.0).all():
        raise ConfigurationError(f"radii must be 0 m or more, got {r}")
    return np.asarray(np.linalg.norm(a - b, axis=-1) - r)


def plane_gap(point: ArrayLike, normal: ArrayLike, offset: ArrayLike, radius: ArrayLike = 0.0) -> Array:
    """Signed distance of a sphere from the half-space behind a plane, shape (...), m.

    Args:
        point: The sphere's centre, shape (..., d), m.
        normal: Of the plane, pointing at the free side, shape (..., d), of any length but 0.
        offset: Where the plane is, `normal @ x = offset`, shape (...).
        radius: At least 0, m.
    """
    p, n = finite_arrays(point=point, normal=normal)
    o, r = finite_arrays(offset=offset, radius=radius)
    length = np.linalg.norm(n, axis=-1) if n.ndim else np.zeros(())
    if not (length > 0.0).all():
        raise ConfigurationError(f"normal must be a vector other than 0, shape (..., d), got {n}")
    if not (r >= 0.0).all():
        raise ConfigurationError(f"radius must be 0 m or more, got {r}")
    return np.asarray(((p * n).sum(axis=-1) - o) / length - r)


def unilateral_force(
    gap: ArrayLike, gap_rate: ArrayLike, stiffness: ArrayLike, damping: ArrayLike = 0.0
) -> Array:
    """Force of a contact that gives way, `max(0, -k gap - c gap')` where closed, else 0, shape (...), N.

    A spring and a damper side by side, cut where they would pull.

    Args:
        gap: Signed distance, m.
        gap_rate: m/s, negative while closing.
        stiffness: k, at least 0, N/m.
        damping: c, at least 0, N s/m.
    """
    g, v, k, c = finite_arrays(gap=gap, gap_rate=gap_rate, stiffness=stiffness, damping=damping)
    if not ((k >= 0.0) & (c >= 0.0)).all():
        raise ConfigurationError(f"stiffness and damping must be 0 or more, got {k} and {c}")
    return np.asarray(np.where(g < 0.0, np.maximum(-k * g - c * v, 0.0), 0.0))
