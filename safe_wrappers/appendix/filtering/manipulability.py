"""The velocity ellipsoid, least-norm joint rates, and Jacobians in other frames.

Source: appendix "Forward kinematics and singularities". See `safe_wrappers.control.filtering.manipulability` for
conventions and caveats.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, finite_array
from safe_wrappers.control.filtering.manipulability import (
    EPSILON,
    checked_jacobian,
    pseudo_inverse,
    task_rows,
)
from safe_wrappers.control.numerics.spatial import cross
from safe_wrappers.errors import ConfigurationError


@dataclass(frozen=True, slots=True)
class VelocityEllipsoid:
    """The twists that joint rates of norm 1 reach: semi-axes of an ellipsoid in task space.

    Attributes:
        axes: Unit vectors as columns, the longest first, shape (..., m, m).
        lengths: Of the semi-axes, task speed per joint rate: J's singular values, shape (..., m).
    """

    axes: Array
    lengths: Array

    @property
    def smallest(self) -> Array:
        """The smallest singular value, shape (...): the speed in the worst direction per joint rate."""
        return np.asarray(self.lengths[..., -1])

    @property
    def condition(self) -> Array:
        """Longest over shortest, shape (...), >= 1; inf at rank loss, and for a Jacobian of zeros."""
        longest, shortest = self.lengths[..., 0], self.lengths[..., -1]
        lost = shortest <= self.lengths.shape[-1] * EPSILON * longest
        return np.asarray(np.where(lost, np.inf, longest / np.where(lost, 1.0, shortest)))


def velocity_ellipsoid(jacobian: ArrayLike) -> VelocityEllipsoid:
    """Axes and lengths of the velocity ellipsoid of a Jacobian of shape (..., m, n), by SVD."""
    j = checked_jacobian(jacobian)
    m, n = j.shape[-2:]
    axes, lengths, _ = np.linalg.svd(j, full_matrices=True)
    if n < m:
        lengths = np.concatenate([lengths, np.zeros((*lengths.shape[:-1], m - n))], axis=-1)
    return VelocityEllipsoid(axes, lengths)


def joint_rates(jacobian: ArrayLike, twist: ArrayLike) -> Array:
    """Joint rates of the least norm whose twist comes closest to the wanted one, shape (..., n).

    The ideal inverse model. Near rank loss the rates grow without bound; past the rounding (a singular value below
    max(m, n) times the machine's precision times the largest) a direction counts as lost and is not asked for.

    Args:
        jacobian: Shape (..., m, n).
        twist: Shape (..., m), per second.
    """
    j, wanted = checked_jacobian(jacobian), finite_array("twist", twist)
    if wanted.ndim < 1 or wanted.shape[-1] != j.shape[-2]:
        raise ConfigurationError(f"twist has the shape (..., {j.shape[-2]}), got {wanted.shape}")
    return np.asarray(np.einsum("...nm,...m->...n", pseudo_inverse(j), wanted))


def reframed(jacobian: ArrayLike, rotation: ArrayLike, offset: ArrayLike) -> Array:
    """A six-row Jacobian in another frame, shape (..., 6, n).

    Twists are (velocity of a point, angular velocity), as MuJoCo has them: of the point itself, in the world's axes.
    From there, with R the end-effector's axes and p its place in the world,

    * the **body** twist is `reframed(J, R, 0)`: the same point, in its own axes;
    * the **spatial** twist is `reframed(J, eye(3), -p)`: of the point that passes through the world's origin.

    Args:
        jacobian: Shape (..., 6, n): three rows of a point's velocity, three of the angular velocity.
        rotation: The new axes as columns, in the old ones, shape (..., 3, 3); refused if not orthonormal.
        offset: New point of reference minus the old one, in the old axes, m, shape (..., 3).
    """
    j, r, p = checked_jacobian(jacobian), finite_array("rotation", rotation), finite_array("offset", offset)
    if j.shape[-2] != 6:
        raise ConfigurationError(f"a twist has six rows, got a Jacobian of shape {j.shape}")
    if r.shape[-2:] != (3, 3) or np.abs(np.swapaxes(r, -1, -2) @ r - np.eye(3)).max(initial=0.0) > 1e-6:
        raise ConfigurationError(f"rotation is orthonormal, of shape (..., 3, 3); got {rotation!r}")
    if p.ndim < 1 or p.shape[-1] != 3:
        raise ConfigurationError(f"offset has the shape (..., 3), got {p.shape}")
    v, w = j[..., :3, :], j[..., 3:, :]
    there = v + np.swapaxes(cross(np.swapaxes(w, -1, -2), p[..., None, :]), -1, -2)
    back = np.swapaxes(r, -1, -2)
    return np.concatenate([back @ there, back @ w], axis=-2)


def task_jacobian(
    jacobian: ArrayLike, directions: str = "xyz", rotations: str = "", length: float | None = None
) -> Array:
    """The rows of a six-row Jacobian that a task is about, shape (..., m, n).

    Args:
        jacobian: Shape (..., 6, n), see `reframed`.
        directions: Of translation: some of "xyz", in the Jacobian's own axes.
        rotations: Likewise, about which axes.
        length: By which a rotation counts as a translation, m: of the tool, say. Needed if there are both, which
            have no unit in common.
    """
    j = checked_jacobian(jacobian)
    if j.shape[-2] != 6:
        raise ConfigurationError(f"a twist has six rows, got a Jacobian of shape {j.shape}")
    rows, scale = task_rows(directions, rotations, length)
    return np.asarray(j[..., rows, :] * scale[:, None])
