"""Manipulability: distance of a pose from a singularity of its task, and the joint rates needed near it.

Source: appendix "Forward kinematics and singularities", and its footnote 3 (Yoshikawa's measure). For a task Jacobian
J of shape (m, n), twist = J @ joint rates, `w = sqrt(det(J J'))` is the product of J's singular values. w = 0 is rank
loss.

* **w does not bound the smallest singular value**, and so no joint rate. A threshold on w has to be validated for the
  machine (`validated_threshold`).
* Rows of translation (m/rad for a hinge) and of rotation (rad/rad) do not add up. A task that has both needs a length
  that weighs rotations (`task_rows`); w depends on it by a constant factor.
* w of all six rows is the same in each frame; w of some rows and singular values are not.

Jacobians are of shape (..., m, n); what is not finite raises `ConfigurationError`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.checks import Array, finite_array, finite_arrays, positive
from safe_wrappers.control.numerics.spatial import cross
from safe_wrappers.errors import ConfigurationError

EPSILON = float(np.finfo(np.float64).eps)


def manipulability(jacobian: ArrayLike) -> Array:
    """`w = sqrt(det(J J'))`, shape (...), never below zero; exactly zero where rows depend on each other, or n < m.

    By a QR factorisation of J', as accurate as an SVD in a quarter of the time. In (m/s)^m per (rad/s)^m for m
    translations and hinges.
    """
    j = checked_jacobian(jacobian)
    m, n = j.shape[-2:]
    if n < m:
        return np.zeros(j.shape[:-2])
    diagonal = np.abs(np.diagonal(np.linalg.qr(np.swapaxes(j, -1, -2), mode="r"), axis1=-2, axis2=-1))
    # A dependent row leaves rounding on the diagonal, in proportion to its own length.
    noise = n * EPSILON * np.linalg.norm(j, axis=-1)
    return np.asarray(np.prod(np.where(diagonal > noise, diagonal, 0.0), axis=-1))


def manipulability_gradient(jacobian: ArrayLike, derivative: ArrayLike) -> Array:
    """dw/dq, shape (..., k): `w tr(J^+ dJ/dq_k)`, without dividing by a vanishing singular value.

    w has a kink where it is zero; there the slope of one side is returned.

    Args:
        jacobian: Shape (..., m, n), n >= m.
        derivative: dJ/dq_k, shape (..., k, m, n), as from `chain_derivative`.
    """
    j, d = checked_jacobian(jacobian), finite_array("derivative", derivative)
    m, n = j.shape[-2:]
    if d.ndim < 3 or d.shape[-2:] != (m, n):
        raise ConfigurationError(f"derivative has the shape (..., k, {m}, {n}), got {d.shape}")
    if n < m:
        raise ConfigurationError(f"with {n} joints and {m} task directions w is zero everywhere")
    left, lengths, right = np.linalg.svd(j, full_matrices=False)
    ahead, behind = np.ones_like(lengths), np.ones_like(lengths)
    np.cumprod(lengths[..., :-1], axis=-1, out=ahead[..., 1:])
    np.cumprod(lengths[..., :0:-1], axis=-1, out=behind[..., -2::-1] if m > 1 else behind[..., :0])
    slopes = np.einsum("...ai,...kab,...ib->...ki", left, d, right)
    return np.asarray(np.einsum("...ki,...i->...k", slopes, ahead * behind))


def chain_derivative(linear: ArrayLike, angular: ArrayLike) -> Array:
    """dJ/dq of a chain of hinges and slides, from its own Jacobian alone: shape (..., n, 6, n), exact.

    `out[..., k, :, j]` is the derivative of column j by joint k.

    Args:
        linear: Velocity of the tip per joint, shape (..., 3, n), in fixed axes; joints in their order from the base.
        angular: Angular velocity of the last link per joint, likewise; zeros for slides.
    """
    v, w = finite_arrays(linear=linear, angular=angular)
    if v.ndim < 2 or v.shape[-2] != 3:
        raise ConfigurationError(f"linear and angular have the shape (..., 3, n), got {v.shape}")
    v, w = np.swapaxes(v, -1, -2), np.swapaxes(w, -1, -2)  # (..., n, 3)
    n = v.shape[-2]
    carried = cross(w[..., :, None, :], v[..., None, :, :])  # w_k x v_j
    turned = cross(w[..., :, None, :], w[..., None, :, :])  # w_k x w_j
    before = np.tri(n, dtype=bool).T[..., None]  # joint k not after joint j
    moves = np.where(before, carried, np.swapaxes(carried, -2, -3))  # else w_j x v_k
    turns = np.where(before, turned, 0.0)
    return np.asarray(np.swapaxes(np.concatenate([moves, turns], axis=-1), -1, -2))


def worst_joint_rates(jacobian: ArrayLike) -> Array:
    """The largest rate of each joint for any twist of norm 1, shape (..., n); inf at rank loss."""
    j = checked_jacobian(jacobian)
    m, n = j.shape[-2:]
    _, lengths, _ = np.linalg.svd(j)
    lost = (lengths[..., -1] <= m * EPSILON * lengths[..., 0]) | (n < m)
    return np.asarray(np.where(lost[..., None], np.inf, np.linalg.norm(pseudo_inverse(j), axis=-1)))


def task_rows(directions: str, rotations: str, length: float | None) -> tuple[NDArray[np.int64], Array]:
    """Which of a twist's six rows a task is about, shape (m,), and what they are multiplied by, shape (m,).

    Raises:
        ConfigurationError: Letters other than x, y, z, or repeated; none at all; translations and rotations together
            without a length, or a length without both.
    """
    for name, given in (("directions", directions), ("rotations", rotations)):
        if not (isinstance(given, str) and set(given) <= set("xyz") and len(set(given)) == len(given)):
            raise ConfigurationError(f'{name} is some of "xyz", each once, or ""; got {given!r}')
    if not directions + rotations:
        raise ConfigurationError('a task has directions (some of "xyz"), rotations, or both; got neither')
    if directions and rotations and length is None:
        raise ConfigurationError(
            "for translations and rotations give the length (m) by which a rotation counts"
        )
    if length is not None and not (directions and rotations):
        raise ConfigurationError("length is for translations and rotations; this task has one of them only")
    factor = 1.0 if length is None else positive("length", length, "m")
    rows = ["xyz".index(d) for d in directions] + [3 + "xyz".index(r) for r in rotations]
    return np.array(rows), np.array([1.0] * len(directions) + [factor] * len(rotations))


@dataclass(frozen=True, slots=True)
class ValidatedThreshold:
    """A threshold on w, validated on a sample of configurations.

    Attributes:
        threshold: The smallest number above which no sampled w needs more than the rate limit; the smallest sampled w
            if none needs more.
        samples: Number of configurations.
        above: Number with a w above the threshold.
        exceeding: Number that need more than the limit, all at or below the threshold.
    """

    threshold: float
    samples: int
    above: int
    exceeding: int

    def unseen(self, confidence: float = 0.95) -> float:
        """Upper bound on the share of configurations above the threshold that exceed the limit.

        Holds with that confidence for independent samples of the distribution in use, not for an adversary's choice.
        """
        if not 0.0 < confidence < 1.0:
            raise ConfigurationError(f"confidence is between 0 and 1, got {confidence!r}")
        return float(-np.expm1(np.log1p(-confidence) / self.samples))


def validated_threshold(jacobians: ArrayLike, task_speed: float, rate_limit: ArrayLike) -> ValidatedThreshold:
    """The smallest threshold on w above which no sampled configuration needs more than the joints' rate limit.

    It holds for controllers that invert J by least norm. `ValidatedThreshold.unseen` bounds the rest statistically.

    Args:
        jacobians: Task Jacobians of sampled configurations, shape (samples, m, n).
        task_speed: Norm of the twist that is to be possible in every direction, task units per second.
        rate_limit: Of the joints, rad/s or m/s; one, or one per joint, shape (n,).

    Raises:
        ConfigurationError: There is none: the configuration of the largest w needs more than the limit.
    """
    j = checked_jacobian(jacobians)
    if j.ndim != 3 or not len(j):
        raise ConfigurationError(f"jacobians has the shape (samples, m, n), samples > 0; got {j.shape}")
    speed, limit = float(finite_array("task_speed", task_speed)), finite_array("rate_limit", rate_limit)
    if speed <= 0.0 or limit.shape not in ((), (j.shape[-1],)) or not (limit > 0.0).all():
        given = f"one limit or {j.shape[-1]} of them; got {task_speed!r} and {rate_limit!r}"
        raise ConfigurationError(f"task_speed and rate_limit are > 0, {given}")
    w = manipulability(j)
    needed = (speed * worst_joint_rates(j) / limit).max(axis=-1)
    exceeding = needed > 1.0
    best = int(np.argmax(w))
    threshold = float(w[exceeding].max()) if exceeding.any() else float(w.min())
    above = int((w > threshold).sum())
    if exceeding.any() and not above:
        raise ConfigurationError(
            f"no threshold on w keeps the rate limit: of {len(j)} configurations the one of the largest w "
            f"({w[best]:.4g}) needs {needed[best]:.3g} times the limit at {speed:g} per second; lower the task speed"
        )
    return ValidatedThreshold(threshold, len(j), above, int(exceeding.sum()))


def pseudo_inverse(jacobian: Array) -> Array:
    """Pseudo-inverse of a Jacobian (..., m, n), shape (..., n, m)."""
    return np.asarray(np.linalg.pinv(jacobian, rcond=max(jacobian.shape[-2:]) * EPSILON))


def checked_jacobian(value: ArrayLike) -> Array:
    """A finite Jacobian as float64, shape (..., m, n)."""
    j = finite_array("jacobian", value)
    if j.ndim < 2 or 0 in j.shape[-2:]:
        raise ConfigurationError(f"a Jacobian has the shape (..., directions, joints), got {j.shape}")
    return j
