"""Covariance of an estimate without measurements: exact steps of time, and the time until a tolerance is reached.

The system is linear, x' = A x + b + w, with white noise of the *intensity* Q (covariance kernel Q delta(t - s)), in
units of x^2 / s. Without measurements the covariance follows the Lyapunov equation P' = A P + P A' + Q. How much
probability lies outside k sigma depends on the tail.

Source: appendix "Continuous covariance propagation and observability"; Van Loan (1978) for the discretisation.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.checks import Array, finite_array
from safe_wrappers.errors import ConfigurationError

_SYMMETRY = 1e-9
"""Relative asymmetry, and relative size of negative eigenvalues, up to which they count as rounding."""
_GOAL = 1e-12
"""Relative reserve below the tolerance, so that rounding never makes a time late."""
_LARGEST = 1e60
"""Larger tolerances are replaced by this one, so that the covariance does not overflow before it is reached."""
_ORDER = 12
"""Terms of the Taylor series: at the longest window the remainder is 1e-5 of the rate's norm times the window."""
_RESOLUTION = 1e-9
"""Relative to the time: the search ends where no longer window is free."""


class Discrete(NamedTuple):
    """x -> F x plus noise of covariance Q_d over one step of time: F = exp(A t) and Q_d, shape (..., n, n) each."""

    transition: Array
    noise: Array


def checked_covariance(name: str, matrix: ArrayLike, n: int | None = None) -> Array:
    """A covariance or a noise intensity as float64, shape (..., n, n), rounding-sized asymmetry removed.

    Raises:
        ConfigurationError: Not a finite square matrix (of size n, if given), not symmetric, or a negative eigenvalue.
    """
    symmetric, smallest, largest = _symmetric(name, matrix, n)
    if smallest < -_SYMMETRY * largest:
        raise ConfigurationError(f"{name} must be positive semidefinite, has the eigenvalue {smallest:.6g}")
    return symmetric


def checked_noise(name: str, matrix: ArrayLike, n: int | None = None) -> Array:
    """As `checked_covariance`, but positive definite: no measurement is exact."""
    symmetric, smallest, largest = _symmetric(name, matrix, n)
    if not smallest > 1e-14 * largest:
        raise ConfigurationError(
            f"{name} must be positive definite but its smallest eigenvalue is {smallest:.6g}"
        )
    return symmetric


def discretise(A: ArrayLike, Q: ArrayLike, time_s: ArrayLike) -> Discrete:
    """The exact step over a time: transition and noise, shape (..., n, n) each; identity and zero for time 0.

    Args:
        A: System matrix, 1/s, shape (n, n).
        Q: Intensity of the process noise, positive semidefinite, shape (n, n).
        time_s: s, at least 0, shape (...).

    Raises:
        ConfigurationError: Bad matrices, a negative time, or a growth that leaves the range of floats.
    """
    a, q = checked_system(A, Q)
    times = checked_times(time_s)
    step = _van_loan(a, q, times)
    refuse_overflow(times, *step)
    return step


def discretise_drift(A: ArrayLike, b: ArrayLike, time_s: ArrayLike) -> Array:
    """Displacement by a constant drift, the integral of `exp(A s) b` over a time, shape (k..., ..., n).

    Args:
        A: System matrix, 1/s, shape (n, n).
        b: Drift of x' = A x + b, shape (..., n).
        time_s: s, at least 0, shape (k...).

    Raises:
        ConfigurationError: Bad matrices, a negative time, or a growth that leaves the range of floats.
    """
    a = checked_square("A", A)
    times = checked_times(time_s)
    drift = finite_array("b", b)
    if drift.ndim == 0 or drift.shape[-1] != len(a):
        raise ConfigurationError(f"b must have {len(a)} entries, one per state of A, got shape {drift.shape}")
    with np.errstate(over="ignore", invalid="ignore"):
        carried = np.tensordot(_integral(a, times), drift, axes=(-1, -1))
    carried = np.moveaxis(carried, times.ndim, -1)
    refuse_overflow(times, carried)
    return np.asarray(carried)


def blind_time(
    P0: ArrayLike,
    A: ArrayLike,
    Q: ArrayLike,
    direction: ArrayLike,
    tolerance: float,
    sigmas: float,
    horizon_s: float,
) -> float:
    """The first time without measurements, s, at which `sigmas` standard deviations reach a tolerance; never late.

    0 if it is reached already; inf if it is not reached within the horizon. Growth need not be monotonic.

    Args:
        P0: Covariance when the sensor was lost, shape (n, n).
        A: System matrix, 1/s, shape (n, n).
        Q: Intensity of the process noise, shape (n, n).
        direction: D, direction(s) of the state, shape (n,) or (m, n); of several the worst unit combination counts.
        tolerance: In the units of D x, > 0.
        sigmas: k, > 0.
        horizon_s: How far to look, s, at least 0.

    Raises:
        ConfigurationError: Bad matrices, or a tolerance, k or horizon that is not finite or has the wrong sign.
    """
    a, q = checked_system(A, Q)
    start = checked_covariance("P0", P0, len(a))
    rows = np.atleast_2d(finite_array("direction", direction))
    if start.ndim != 2 or rows.ndim != 2 or rows.shape[1] != len(a):
        given, n = f"{start.shape} and {np.shape(direction)}", len(a)
        raise ConfigurationError(f"P0 has shape {n, n}, direction ({n},) or (m, {n}), got {given}")
    for name, value in (("tolerance", tolerance), ("sigmas", sigmas)):
        if not (math.isfinite(value) and value > 0.0):
            raise ConfigurationError(f"{name} must be finite and above 0, got {value!r}")
    horizon = float(checked_times(horizon_s, "horizon_s"))
    goal = min(float(tolerance) / float(sigmas), _LARGEST) ** 2 * (1.0 - _GOAL)
    return _first_crossing(start, a, q, rows, goal, horizon)


def _first_crossing(P0: Array, a: Array, q: Array, rows: Array, goal: float, horizon: float) -> float:
    """The time up to which the largest eigenvalue of `D P(t) D'` stays below a goal; inf if up to the horizon.

    Each window is shown to be free by the better of two estimates from the rate X = dP/dt, which obeys X' = A X + X
    A': the Taylor series of the variance with its remainder (tight, for windows up to 1 over the norm of A), or the
    growth by the positive part of the rate alone (for windows of any length).
    """
    if _largest_variance(rows, P0) >= goal:
        return 0.0
    # The remainder is bounded by norms, which are tightest in balanced coordinates.
    from scipy.linalg import matrix_balance  # here: SciPy takes a while to import

    a, scales = matrix_balance(a, permute=False)
    inverse = np.linalg.inv(scales)
    P0, q, rows = inverse @ P0 @ inverse.T, inverse @ q @ inverse.T, rows @ scales
    speed, length = float(np.linalg.norm(a, 2)), float(np.linalg.norm(rows, 2))
    time = 0.0
    while True:
        step = _van_loan(a, q, np.asarray(time))
        now = step.transition @ P0 @ step.transition.T + step.noise
        rate = derivative = _rate(now, a) + q
        curve = [0.0, 0.0]
        for order in range(2, _ORDER + 1):
            derivative = _rate(derivative, a)
            curve.append(max(0.0, _largest_variance(rows, derivative)) / math.factorial(order))
        # |exp(A s) X exp(A s)'| <= e^2 |X| while |A| s <= 1.
        rest = math.exp(2.0) * length**2 * float(np.linalg.norm(_rate(derivative, a), 2))
        curve.append(rest / math.factorial(_ORDER + 1))
        room = horizon - time
        longest = room if rest == 0.0 else min(room, 1.0 / speed)
        free = _free_by_series(rows @ now @ rows.T, rows @ rate @ rows.T, curve, goal, longest)
        if free == longest < room:
            free = _free_by_rise(rows @ now @ rows.T, rate, a, rows, goal, longest, room)
        if free == room:
            return math.inf
        if free <= _RESOLUTION * (time + free):
            return time
        time += free


def _largest_variance(rows: Array, covariance: Array) -> float:
    """Largest eigenvalue of `D P D'`: of D x, over all unit combinations of its entries."""
    return float(np.linalg.eigvalsh(rows @ covariance @ rows.T)[-1])


def _free_by_series(value: Array, slope: Array, curve: list[float], goal: float, longest: float) -> float:
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
    for window, rise in zip(windows, _van_loan(a, rising, windows).noise, strict=True):
        if not (np.isfinite(rise).all() and np.linalg.eigvalsh(value + rows @ rise @ rows.T)[-1] < goal):
            break
        free = float(window)
    return free


def _rate(covariance: Array, a: Array) -> Array:
    flow = a @ covariance
    return np.asarray(flow + flow.T)


def _symmetric(name: str, matrix: ArrayLike, n: int | None) -> tuple[Array, float, float]:
    """The matrix, its smallest eigenvalue and the largest absolute value of one."""
    given = finite_array(name, matrix)
    if given.ndim < 2 or given.shape[-1] != given.shape[-2] or given.shape[-1] == 0:
        raise ConfigurationError(f"{name} must be a square matrix, got shape {given.shape}")
    if n is not None and given.shape[-1] != n:
        raise ConfigurationError(f"{name} must be {n} x {n}, got shape {given.shape}")
    turned = np.swapaxes(given, -1, -2)
    asymmetry = float(np.abs(given - turned).max(initial=0.0))
    if asymmetry > _SYMMETRY * float(np.abs(given).max(initial=0.0)):
        raise ConfigurationError(f"{name} must be symmetric, its entries differ by up to {asymmetry:.6g}")
    symmetric = 0.5 * (given + turned)
    values = np.linalg.eigvalsh(symmetric)
    return symmetric, float(values.min(initial=np.inf)), float(np.abs(values).max(initial=0.0))


def checked_square(name: str, matrix: ArrayLike) -> Array:
    """A finite square matrix as float64, shape (n, n)."""
    given = finite_array(name, matrix)
    if given.ndim != 2 or given.shape[0] != given.shape[1] or given.size == 0:
        raise ConfigurationError(f"{name} must be a square matrix, got shape {given.shape}")
    return given


def checked_system(A: ArrayLike, Q: ArrayLike) -> tuple[Array, Array]:
    """A and Q as float64, shape (n, n) each, Q symmetric and positive semidefinite."""
    a = checked_square("A", A)
    return a, checked_covariance("Q", checked_square("Q", Q), len(a))


def checked_times(time_s: ArrayLike, name: str = "time_s") -> Array:
    """Finite times of at least 0 s as float64, shape (...)."""
    times = finite_array(name, time_s)
    if (times < 0.0).any():
        raise ConfigurationError(f"{name} must be at least 0 s, got {time_s!r}: time does not run backwards")
    return times


def refuse_overflow(times: Array, *results: Array) -> None:
    """Refuse results that are not finite."""
    if not all(np.isfinite(result).all() for result in results):
        raise ConfigurationError(f"within time_s = {np.max(times):.6g} s an unstable mode of A overflows")


def _van_loan(a: Array, q: Array, times: Array) -> Discrete:
    """`discretise` without its checks: over a time so short that it is well conditioned, then doubled."""
    n, size = len(a), _norm_or_one(q)
    doublings = _doublings(a, times)
    base = (times / 2.0**doublings)[..., None, None]
    block = np.zeros((*times.shape, 2 * n, 2 * n))
    block[..., :n, :n], block[..., n:, n:] = -a * base, a.T * base
    block[..., :n, n:] = q / size
    exponential = _exponential(block)
    transition = np.swapaxes(exponential[..., n:, n:], -1, -2)
    noise = transition @ exponential[..., :n, n:] * (size * base)
    with np.errstate(over="ignore", invalid="ignore"):
        for level in range(int(doublings.max(initial=0))):
            on = (doublings > level)[..., None, None]
            noise = np.where(on, transition @ noise @ np.swapaxes(transition, -1, -2) + noise, noise)
            transition = np.where(on, transition @ transition, transition)
    return Discrete(transition, 0.5 * (noise + np.swapaxes(noise, -1, -2)))


def _integral(a: Array, times: Array) -> Array:
    """The integral of `exp(A s)` from 0 to each time, shape (..., n, n)."""
    n, doublings = len(a), _doublings(a, times)
    base = (times / 2.0**doublings)[..., None, None]
    block = np.zeros((*times.shape, 2 * n, 2 * n))
    block[..., :n, :n], block[..., :n, n:] = a * base, np.eye(n)
    exponential = _exponential(block)
    transition, summed = exponential[..., :n, :n], exponential[..., :n, n:] * base
    with np.errstate(over="ignore", invalid="ignore"):
        for level in range(int(doublings.max(initial=0))):
            on = (doublings > level)[..., None, None]
            summed = np.where(on, transition @ summed + summed, summed)
            transition = np.where(on, transition @ transition, transition)
    return np.asarray(summed)


def _exponential(matrix: Array) -> Array:
    from scipy.linalg import expm  # here: SciPy takes a while to import

    return np.asarray(expm(matrix))


def _norm_or_one(matrix: Array) -> float:
    return float(np.linalg.norm(matrix)) or 1.0


def _doublings(a: Array, times: Array) -> NDArray[np.int64]:
    """Number of halvings of each time until the exponential is well conditioned."""
    rate = _norm_or_one(a)
    return np.maximum(np.ceil(np.log2(np.maximum(rate * times, 1.0))), 0.0).astype(np.int64)
