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

from safe_wrappers.checks import Array


class Discrete(NamedTuple):
    """x -> F x plus noise of covariance Q_d over one step of time: F = exp(A t) and Q_d, shape (n, n) each."""

    transition: Array
    noise: Array


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
