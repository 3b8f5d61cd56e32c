"""Manipulability: distance of a pose from a singularity of its task, and the joint rates needed near it.

Source: appendix "Forward kinematics and singularities", and its footnote 3 (Yoshikawa's measure). For a task Jacobian
J of shape (m, n), twist = J @ joint rates, `w = sqrt(det(J J'))` is the product of J's singular values. w = 0 is rank
loss.

* **w does not bound the smallest singular value**, and so no joint rate. A threshold on w has to be validated for the
  machine (`validated_threshold`).
* Rows of translation (m/rad for a hinge) and of rotation (rad/rad) do not add up. A task that has both needs a length
  that weighs rotations; w depends on it by a constant factor.
* w of all six rows is the same in each frame; w of some rows and singular values are not.

Jacobians are of shape (..., m, n).
"""

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError

EPSILON = float(np.finfo(np.float64).eps)


def manipulability(jacobian: ArrayLike) -> Array:
    """`w = sqrt(det(J J'))`, shape (...), never below zero; exactly zero where rows depend on each other, or n < m.

    By a QR factorisation of J', as accurate as an SVD in a quarter of the time. In (m/s)^m per (rad/s)^m for m
    translations and hinges. NaN where the Jacobian has one.
    """
    j = np.asarray(jacobian, dtype=np.float64)
    m, n = j.shape[-2:]
    if n < m:
        return np.zeros(j.shape[:-2])
    diagonal = np.abs(np.diagonal(np.linalg.qr(np.swapaxes(j, -1, -2), mode="r"), axis1=-2, axis2=-1))
    # A dependent row leaves rounding on the diagonal, in proportion to its own length.
    noise = n * EPSILON * np.linalg.norm(j, axis=-1)
    return np.asarray(np.prod(np.where(diagonal <= noise, 0.0, diagonal), axis=-1))


def worst_joint_rates(jacobian: ArrayLike) -> Array:
    """The largest rate of each joint for any twist of norm 1, shape (..., n); inf at rank loss."""
    j = np.asarray(jacobian, dtype=np.float64)
    m, n = j.shape[-2:]
    lengths = np.linalg.svd(j, compute_uv=False)
    lost = (lengths[..., -1] <= m * EPSILON * lengths[..., 0]) | (n < m)
    inverse = np.linalg.pinv(j, rcond=max(m, n) * EPSILON)
    return np.asarray(np.where(lost[..., None], np.inf, np.linalg.norm(inverse, axis=-1)))


def validated_threshold(jacobians: ArrayLike, task_speed: float, rate_limit: float) -> float:
    """The smallest threshold on w above which no sampled configuration needs more than the joints' rate limit.

    The smallest sampled w if none needs more. It holds for controllers that invert J by least norm.

    Args:
        jacobians: Task Jacobians of sampled configurations, shape (samples, m, n).
        task_speed: Norm of the twist that is to be possible in every direction, task units per second, > 0.
        rate_limit: Of every joint, rad/s or m/s, > 0.

    Raises:
        ConfigurationError: There is none: the configuration of the largest w needs more than the limit.
    """
    j = np.asarray(jacobians, dtype=np.float64)
    w = manipulability(j)
    needed = (task_speed * worst_joint_rates(j) / rate_limit).max(axis=-1)
    exceeding = needed > 1.0
    best = int(np.argmax(w))
    threshold = float(w[exceeding].max()) if exceeding.any() else float(w.min())
    if exceeding.any() and not (w > threshold).any():
        raise ConfigurationError(
            f"no threshold on w keeps the rate limit: of {len(j)} configurations the one of the largest w "
            f"({w[best]:.4g}) needs {needed[best]:.3g} times the limit at {task_speed:g} per second; lower the task "
            "speed"
        )
    return threshold
