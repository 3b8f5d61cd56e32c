"""Barrier conditions on a control, and manipulability as a barrier against singular poses.

A barrier `h` is positive inside the safe set. For `x' = f(x) + g(x) u` the condition `Lf h + Lg h u >= -alpha(h)` is
sufficient, in continuous time, for a barrier of relative degree one, while some admissible control satisfies it.
Between samples: `control/backup/stopping.py`.

For a task Jacobian J of shape (m, n), twist = J @ joint rates, `w = sqrt(det(J J'))` is the product of J's singular
values. w = 0 is rank loss.

* **w does not bound the smallest singular value**, and so no joint rate. A threshold on w has to be validated for the
  machine (`validated_threshold`).
* Rows of translation (m/rad for a hinge) and of rotation (rad/rad) do not add up. A task that has both needs a length
  that weighs rotations; w depends on it by a constant factor.
* w of all six rows is the same in each frame; w of some rows and singular values are not.

Source: appendix "Safety and Control Barrier Functions"; "Forward kinematics and singularities" and its footnote 3
(Yoshikawa's measure).
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.errors import Array, ConfigurationError

EPSILON = float(np.finfo(np.float64).eps)


def numerical_gradient(h: Callable[[Array], float], x: ArrayLike, step: float = 1e-6) -> Array:
    """Central differences of a scalar function, shape (n,); the step is relative for large entries."""
    point = np.asarray(x, dtype=np.float64)
    gradient = np.empty_like(point)
    for i in range(point.size):
        width = step * max(1.0, abs(point[i]))
        ahead, behind = point.copy(), point.copy()
        ahead[i] += width
        behind[i] -= width
        gradient[i] = (float(h(ahead)) - float(h(behind))) / (ahead[i] - behind[i])
    return gradient


def acts(gradient: Array, effect: Array, height: float, share: float) -> bool:
    """Whether some control enters the derivative of a function, up to the relative tolerance `share`.

    The gradient has shape (n,), the effect g shape (n, m). A gradient below a hundredth of the function's value
    `height` may be round-off of finite differences.
    """
    size = max(float(np.abs(gradient).max(initial=0.0)), 1e-2 * abs(height))
    return bool((np.abs(gradient @ effect) > share * size * np.abs(effect).max(axis=0, initial=0.0)).any())


def relative_degree(
    h: Callable[[Array], float],
    f: Callable[[Array], Array],
    g: Callable[[Array], Array],
    x: ArrayLike,
    max_degree: int = 3,
    tolerance: float = 1e-6,
) -> int | None:
    """The number of time derivatives of h until the control appears, at one state; None if it is above `max_degree`.

    Lie derivatives are nested central differences; `tolerance` is relative to the sizes of h and of each control's
    column of g. Units of h and of controls do not matter; states should be of order one.
    """
    point = np.asarray(x, dtype=np.float64)
    effect = np.asarray(g(point), dtype=np.float64)
    height = float(h(point))
    current = h
    for degree in range(1, max_degree + 1):
        step = 10.0 ** (-6 + 1.5 * (degree - 1))
        gradient = numerical_gradient(current, point, step)
        if acts(gradient, effect, height, tolerance * 10.0 ** (2 * (degree - 1))):
            return degree
        current = partial(_lie_along, current, f, step)
    return None


def _lie_along(h: Callable[..., float], f: Callable[..., Array], step: float, x: Array) -> float:
    return float(numerical_gradient(h, x, step) @ f(x))


def manipulability(jacobian: ArrayLike) -> Array:
    """`w = sqrt(det(J J'))` of Jacobians (..., m, n), shape (...); NaN where the Jacobian has one.

    By a QR factorisation of J', as accurate as an SVD in a quarter of the time. In (m/s)^m per (rad/s)^m for m
    translations and hinges.
    """
    j = np.asarray(jacobian, dtype=np.float64)
    m, n = j.shape[-2:]
    if n < m:
        return np.zeros(j.shape[:-2])
    triangle = np.linalg.qr(np.swapaxes(j, -1, -2), mode="r")
    return np.asarray(np.abs(np.prod(np.diagonal(triangle, axis1=-2, axis2=-1), axis=-1)))


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
    w = manipulability(jacobians)
    needed = (task_speed * worst_joint_rates(jacobians) / rate_limit).max(axis=-1)
    threshold = float(w[needed > 1.0].max(initial=w.min()))
    best = int(np.argmax(w))
    if needed[best] > 1.0:
        raise ConfigurationError(
            f"no threshold on w keeps the rate limit: of {len(w)} configurations the one of the largest w "
            f"({w[best]:.4g}) needs {needed[best]:.3g} times the limit at {task_speed:g} per second; lower the task "
            "speed"
        )
    return threshold
