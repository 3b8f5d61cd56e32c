"""How much of its friction cone a contact force uses.

Source: appendix "Physical contact feasibility constraints".
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.checks import Array
from safe_wrappers.control.contact.friction_cone import checked_friction, cone_excess, normal_and_tangential


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
