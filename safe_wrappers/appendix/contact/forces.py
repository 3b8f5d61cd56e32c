"""Contact of simple shapes: distances, the force of a compliant contact, use of the friction cone.

Source: appendix "Rigid Body Contact Mechanics" and "Physical contact feasibility constraints".
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.checks import Array, finite_array, finite_arrays
from safe_wrappers.control.contact.friction_cone import checked_friction, cone_excess, normal_and_tangential
from safe_wrappers.errors import ConfigurationError


def sphere_gap(center: ArrayLike, other: ArrayLike, radii: ArrayLike) -> Array:
    """Signed distance of two spheres, shape (...), m.

    Args:
        center: Shape (..., 3) (or (..., 2): discs), m.
        other: The other's, m.
        radii: Sum of both radii, at least 0, shape (...), m. A point has none.
    """
    a, b = finite_arrays(center=center, other=other)
    r = finite_array("radii", radii)
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
    """Force of a compliant contact, `max(0, -k gap - c gap')` where closed, else 0, shape (...), N.

    A spring and a damper in parallel, without tension.

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


def friction_ratio(forces: ArrayLike, normals: ArrayLike, friction: ArrayLike) -> Array:
    """Used share of the friction, `|f_t| / (mu f_n)`, shape (...): at most 1 inside the cone.

    Infinite where the ground would have to pull, or to hold sideways without pressure; 0 where there is no force.

    Args:
        forces: On the robot, shape (..., 3), N.
        normals: Unit normals, shape (..., 3).
        friction: Coefficient mu, at least 0, shape (...).
    """
    along, rest = normal_and_tangential(forces, normals)
    sideways = np.linalg.norm(rest, axis=-1)
    mu = checked_friction(friction)
    held, sideways = np.broadcast_arrays(mu * along, sideways)
    pulls = np.broadcast_to(along < 0.0, held.shape)
    ratio = np.zeros(held.shape)
    np.divide(sideways, held, out=ratio, where=held > 0.0)
    ratio[(held <= 0.0) & (sideways > 0.0) | pulls] = np.inf
    return ratio


def in_cone(
    forces: ArrayLike, normals: ArrayLike, friction: ArrayLike, tolerance: float = 0.0
) -> NDArray[np.bool_]:
    """Whether each force lies in its friction cone, shape (...).

    Args:
        forces: On the robot, shape (..., 3), N.
        normals: Unit normals, shape (..., 3).
        friction: Coefficient mu, at least 0, shape (...).
        tolerance: Largest accepted violation of either condition, N.
    """
    return np.asarray(cone_excess(forces, normals, friction) <= tolerance)
