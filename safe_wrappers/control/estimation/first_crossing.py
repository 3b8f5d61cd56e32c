"""The first time at which a covariance without measurements reaches a bound in some direction, never late.

The growth need not be monotonic, so the search proceeds by windows, each shown to be below the bound by the better of
two estimates from the rate X = dP/dt, which obeys X' = A X + X A':

- the Taylor series of the variance with its remainder: tight, but only for windows up to 1 over the norm of A;
- the growth by the positive part of the rate alone: it only rises, and holds for windows of any length.

Arguments are checked by the caller, `safe_wrappers.control.estimation.covariance.blind_time`.
"""

import math

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.control.numerics.block_exponentials import van_loan

Array = NDArray[np.float64]

_ORDER = 12
"""Terms of the Taylor series: at the longest window the remainder is 1e-5 of the rate's norm times the window."""
_RESOLUTION = 1e-9
"""Relative to the time: the search ends where no longer window is free."""


def first_crossing(P0: Array, a: Array, q: Array, rows: Array, goal: float, horizon: float) -> float:
    """The time, s, up to which the largest eigenvalue of `D P(t) D'` stays below a goal, P' = A P + P A' + Q.

    0 if the goal is reached at once, inf if it is not within the horizon.

    Args:
        P0: Covariance at time 0, shape (n, n).
        a: A, shape (n, n).
        q: Q, shape (n, n).
        rows: D, shape (m, n).
        goal: Bound on the variance, > 0.
        horizon: Latest time that is considered, s.
    """
    if largest_variance(rows, P0) >= goal:
        return 0.0
    # The remainder is bounded by norms, which are tightest in balanced coordinates.
    from scipy.linalg import matrix_balance  # here: SciPy takes a while to import

    a, scales = matrix_balance(a, permute=False)
    inverse = np.linalg.inv(scales)
    P0, q, rows = inverse @ P0 @ inverse.T, inverse @ q @ inverse.T, rows @ scales
    speed, length = float(np.linalg.norm(a, 2)), float(np.linalg.norm(rows, 2))
    time = 0.0
    while True:
        step = van_loan(a, q, np.asarray(time))
        now = step.transition @ P0 @ step.transition.T + step.noise
        rate = derivative = _rate(now, a) + q
        curve = [0.0, 0.0]
        for order in range(2, _ORDER + 1):
            derivative = _rate(derivative, a)
            curve.append(max(0.0, largest_variance(rows, derivative)) / math.factorial(order))
        # |exp(A s) X exp(A s)'| <= e^2 |X| while |A| s <= 1.
        rest = math.exp(2.0) * length**2 * float(np.linalg.norm(_rate(derivative, a), 2))
        curve.append(rest / math.factorial(_ORDER + 1))
        room = horizon - time
        longest = room if rest == 0.0 else min(room, 1.0 / speed)
        free = _free_by_series(
            rows @ now @ rows.T, rows @ rate @ rows.T, curve, goal, _RESOLUTION * time, longest
        )
        if free == longest < room:
            free = _free_by_rise(rows @ now @ rows.T, rate, a, rows, goal, longest, room)
        if free == room:
            return math.inf
        if free <= _RESOLUTION * (time + free):
            return time
        time += free


def largest_variance(rows: Array, covariance: Array) -> float:
    """Largest eigenvalue of `D P D'`: of D x, over all unit combinations of its entries."""
    return float(np.linalg.eigvalsh(rows @ covariance @ rows.T)[-1])


def _free_by_series(
    value: Array, slope: Array, curve: list[float], goal: float, shortest: float, longest: float
) -> float:
    """The longest window in which `value + slope t + sum of curve[k] t^k` stays below the goal, as `value` does."""

    def peak(time: float) -> float:
        # The largest eigenvalue of value + slope t is convex in t: over a window it is largest at an end.
        bound = 0.0
        for factor in reversed(curve):
            bound = bound * time + factor
        return bound + float(np.linalg.eigvalsh(value + time * slope)[-1])

    if peak(longest) < goal:
        return longest
    free, crossed = 0.0, longest
    while crossed - free > 1e-6 * crossed:
        middle = 0.5 * (free + crossed)
        free, crossed = (middle, crossed) if peak(middle) < goal else (free, middle)
    return free


def _free_by_rise(
    value: Array, rate: Array, a: Array, rows: Array, goal: float, shortest: float, room: float
) -> float:
    """A window, of at least the shortest, in which the positive part of the rate alone stays below the goal."""
    signs, vectors = np.linalg.eigh(rate)
    rising = (vectors * np.maximum(signs, 0.0)) @ vectors.T
    windows = np.minimum(shortest * 4.0 ** np.arange(1, 11), room)
    free = shortest
    for window, rise in zip(windows, van_loan(a, rising, windows).noise, strict=True):
        if not (np.isfinite(rise).all() and np.linalg.eigvalsh(value + rows @ rise @ rows.T)[-1] < goal):
            break
        free = float(window)
    return free


def _rate(covariance: Array, a: Array) -> Array:
    flow = a @ covariance
    return np.asarray(flow + flow.T)
