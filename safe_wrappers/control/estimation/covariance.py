"""Covariance of an estimate without measurements: exact steps of time.

The system is linear, x' = A x + b + w, with white noise of the *intensity* Q (covariance kernel Q delta(t - s)), in
units of x^2 / s. Without measurements the covariance follows the Lyapunov equation P' = A P + P A' + Q.

Source: appendix "Continuous covariance propagation and observability"; Van Loan (1978) for the discretisation;
Anderson and Moore, "Optimal Filtering" (1979), section 6.7, for doubling.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, finite_array
from safe_wrappers.errors import ConfigurationError

_SYMMETRY = 1e-9
"""Relative asymmetry, and relative size of negative eigenvalues, up to which they count as rounding."""


class Discrete(NamedTuple):
    """x -> F x plus noise of covariance Q_d over one step of time: F = exp(A t) and Q_d, shape (n, n) each."""

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


def discretise(A: ArrayLike, Q: ArrayLike, time_s: float) -> Discrete:
    """The exact step over a time; identity and zero for time 0.

    The exponential is taken over a time in which A changes little, where it is well conditioned, and doubled.

    Args:
        A: System matrix, 1/s, shape (n, n).
        Q: Intensity of the process noise, positive semidefinite, shape (n, n).
        time_s: s, at least 0.

    Raises:
        ConfigurationError: Bad matrices, a negative time, or a growth that leaves the range of floats.
    """
    from scipy.linalg import expm  # here: SciPy takes a while to import

    a = checked_square("A", A)
    n, time = len(a), checked_time(time_s)
    q = checked_covariance("Q", Q, n)
    size = float(np.linalg.norm(q)) or 1.0
    doublings = max(math.ceil(math.log2(max(float(np.linalg.norm(a)) * time, 1.0))), 0)
    base = time / 2.0**doublings
    exponential = expm(base * np.block([[-a, q / size], [np.zeros((n, n)), a.T]]))
    transition = exponential[n:, n:].T
    noise = size * (transition @ exponential[:n, n:])
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(doublings):
            noise = transition @ noise @ transition.T + noise
            transition = transition @ transition
    refuse_overflow(time, transition, noise)
    return Discrete(transition, 0.5 * (noise + noise.T))


def discretise_drift(A: ArrayLike, b: ArrayLike, time_s: float) -> Array:
    """Displacement by a constant drift, the integral of `exp(A s) b` over a time, shape (n,).

    Args:
        A: System matrix, 1/s, shape (n, n).
        b: Drift of x' = A x + b, shape (n,).
        time_s: s, at least 0.

    Raises:
        ConfigurationError: Bad matrices, a negative time, or a growth that leaves the range of floats.
    """
    from scipy.linalg import expm

    a, drift, time = checked_square("A", A), finite_array("b", b), checked_time(time_s)
    if drift.shape != (len(a),):
        raise ConfigurationError(f"b must have {len(a)} entries, one per state of A, got shape {drift.shape}")
    with np.errstate(over="ignore", invalid="ignore"):
        carried = expm(time * np.block([[a, drift[:, None]], [np.zeros((1, len(a) + 1))]]))[:-1, -1]
    refuse_overflow(time, carried)
    return np.asarray(carried)


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


def checked_time(time_s: float) -> float:
    """A finite time of at least 0 s."""
    time = float(finite_array("time_s", time_s))
    if time < 0.0:
        raise ConfigurationError(f"time_s must be at least 0 s, got {time_s!r}: time does not run backwards")
    return time


def refuse_overflow(time_s: float, *results: Array) -> None:
    """Refuse results that are not finite."""
    if not all(np.isfinite(result).all() for result in results):
        raise ConfigurationError(f"within time_s = {time_s:.6g} s an unstable mode of A overflows")
