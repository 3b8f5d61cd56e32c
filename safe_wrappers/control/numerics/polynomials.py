"""Polynomials of low degree, many at a time: values and derivatives.

Coefficients lie on the last axis, lowest power first; every axis before it is a batch.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def differentiate(coefficients: ArrayLike, times: int = 1) -> Array:
    """Coefficients of the derivative; a constant's is the constant 0."""
    c = np.asarray(coefficients, dtype=np.float64)
    for _ in range(times):
        c = c[..., 1:] * np.arange(1, c.shape[-1]) if c.shape[-1] > 1 else np.zeros_like(c)
    return c


def value(coefficients: Array, x: ArrayLike) -> Array:
    """The polynomials at x, which broadcasts with the batch axes (Horner's scheme)."""
    x = np.asarray(x, dtype=np.float64)
    total = coefficients[..., -1] + 0.0 * x
    for power in range(coefficients.shape[-1] - 2, -1, -1):
        total = total * x + coefficients[..., power]
    return np.asarray(total)
