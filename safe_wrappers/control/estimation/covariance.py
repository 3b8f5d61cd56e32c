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
    """
    from scipy.linalg import expm  # here: SciPy takes a while to import

    a, q = np.asarray(A, dtype=np.float64), np.asarray(Q, dtype=np.float64)
    n, size = len(a), float(np.linalg.norm(q)) or 1.0
    doublings = max(math.ceil(math.log2(max(float(np.linalg.norm(a)) * time_s, 1.0))), 0)
    base = time_s / 2.0**doublings
    exponential = expm(base * np.block([[-a, q / size], [np.zeros((n, n)), a.T]]))
    transition = exponential[n:, n:].T
    noise = size * (transition @ exponential[:n, n:])
    for _ in range(doublings):
        noise = transition @ noise @ transition.T + noise
        transition = transition @ transition
    return Discrete(transition, 0.5 * (noise + noise.T))


def discretise_drift(A: ArrayLike, b: ArrayLike, time_s: float) -> Array:
    """Displacement by a constant drift, the integral of `exp(A s) b` over a time of at least 0 s, shape (n,).

    A, 1/s, has the shape (n, n), the drift b of x' = A x + b the shape (n,).
    """
    from scipy.linalg import expm

    a, drift = np.asarray(A, dtype=np.float64), np.asarray(b, dtype=np.float64)
    whole = np.block([[a, drift[:, None]], [np.zeros((1, len(a) + 1))]])
    return np.asarray(expm(time_s * whole)[:-1, -1])


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
