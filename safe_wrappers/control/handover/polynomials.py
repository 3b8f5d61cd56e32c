"""Exact extrema of polynomials of low degree over an interval, many at a time.

Coefficients lie on the last axis, lowest power first; every axis before it is a batch.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.checks import Array
from safe_wrappers.control.handover.splines import differentiate, value

_MOST_STEPS = 120


_PRECISION = 4.0 * np.finfo(np.float64).eps


class Extrema(NamedTuple):
    """The smallest and the largest value over a closed interval, and where they are taken.

    Attributes:
        minimum, maximum: The values, shape (...).
        minimum_at, maximum_at: The times, shape (...); the first of several.
    """

    minimum: Array
    maximum: Array
    minimum_at: Array
    maximum_at: Array

    @property
    def peak(self) -> Array:
        """Largest magnitude over the interval, shape (...)."""
        return np.asarray(np.maximum(np.abs(self.minimum), np.abs(self.maximum)))


def bracketed_root(coefficients: Array, low: Array, high: Array, start: Array) -> Array:
    """The root in [low, high] of polynomials that are monotone there, by Newton's steps kept in the bracket.

    Where the signs at both ends are equal there is none, and `low` is returned.

    Args:
        coefficients: Shape (..., n).
        low: Lower ends of the brackets, shape (...).
        high: Upper ends, shape (...).
        start: First guesses inside the brackets, shape (...).
    """
    slope = differentiate(coefficients)
    at_low, at_high = value(coefficients, low), value(coefficients, high)
    crosses = np.sign(at_low) * np.sign(at_high) <= 0.0
    rising = at_high > at_low
    a, b = low, np.where(crosses, high, low)
    x = np.where(crosses, start, low)
    for _ in range(_MOST_STEPS):
        y, steepness = value(coefficients, x), value(slope, x)
        below = (y < 0.0) == rising
        a, b = np.where(below, x, a), np.where(below, b, x)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            newton = x - y / steepness
        inside = (newton >= a) & (newton <= b)  # False for a NaN, too
        following = np.where(y == 0.0, x, np.where(inside, newton, 0.5 * (a + b)))
        done = np.abs(following - x) <= _PRECISION * np.abs(x)
        x = following
        if np.all(done | ~crosses):
            break
    return np.where(crosses, x, low)


def unit_roots(coefficients: Array) -> Array:
    """Points of [0, 1], in rising order, that contain every root at which a polynomial changes its sign.

    Shape (..., n - 1) for n coefficients. Points that are no roots are among them: between its own turning
    points, the roots of the derivative, a polynomial is monotone and has one root or none, for which the left
    end stands. So no leading coefficient needs to differ from 0, and no root is complex.
    """
    degree = coefficients.shape[-1] - 1
    batch = coefficients.shape[:-1]
    if degree == 0:
        return np.zeros((*batch, 0))
    turning = unit_roots(differentiate(coefficients))
    ends = np.concatenate([np.zeros((*batch, 1)), turning, np.ones((*batch, 1))], axis=-1)
    low, high = ends[..., :-1], ends[..., 1:]
    return bracketed_root(coefficients[..., None, :], low, high, 0.5 * (low + high))


def extrema(coefficients: ArrayLike, duration: ArrayLike) -> Extrema:
    """Smallest and largest value over [0, duration]: at an end, or where the derivative changes its sign.

    Exact up to rounding: an error in the time enters the value by its square only.

    Args:
        coefficients: Shape (..., n).
        duration: Length of the interval, > 0, shape () or (...).
    """
    c = np.asarray(coefficients, dtype=np.float64)
    span = np.broadcast_to(np.asarray(duration, dtype=np.float64), c.shape[:-1])
    unit = c * span[..., None] ** np.arange(c.shape[-1])
    ends = np.zeros((*c.shape[:-1], 1))
    at = np.concatenate([ends, unit_roots(differentiate(unit)), ends + 1.0], axis=-1)
    values = value(unit[..., None, :], at)
    first, last = np.argmin(values, axis=-1)[..., None], np.argmax(values, axis=-1)[..., None]

    def pick(array: Array, index: NDArray[np.intp]) -> Array:
        return np.asarray(np.take_along_axis(array, index, axis=-1)[..., 0])

    return Extrema(pick(values, first), pick(values, last), pick(at, first) * span, pick(at, last) * span)
