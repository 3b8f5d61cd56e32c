"""Barrier conditions on a control: gradients by differences, whether a control acts, relative degree.

Source: appendix "Safety and Control Barrier Functions". A barrier `h` is positive inside the safe set. For `x' = f(x)
+ g(x) u` the condition `Lf h + Lg h u >= -alpha(h)` is sufficient, in continuous time, for a barrier of relative
degree one, while some admissible control satisfies it. Between samples: `control/backup/stopping.py`.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array


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
