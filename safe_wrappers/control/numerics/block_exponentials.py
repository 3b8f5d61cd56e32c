"""Exact covariance over a time: block matrix exponentials and doubling.

The exponential is taken over a time so short that it is well conditioned; doubling extends it to the full time.
Arguments are checked by `safe_wrappers.control.estimation.covariance`. Results that overflow are not finite.

Source: Van Loan (1978); Anderson and Moore, "Optimal Filtering" (1979), section 6.7, for doubling.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array

_TERMS = 24
"""Terms of the exponential's series: for matrices of norm 2 the first neglected one is below 1e-17."""


class Discrete(NamedTuple):
    """x -> F x plus noise of covariance Q_d over one step of time: F = exp(A t) and Q_d, shape (..., n, n) each."""

    transition: Array
    noise: Array


def van_loan(a: Array, q: Array, times: Array) -> Discrete:
    """`safe_wrappers.control.estimation.covariance.discretise` without its checks."""
    n = len(a)
    size = norm_or_one(q)
    doublings = doublings_for(norm_or_one(a), times)
    base = (times / 2.0**doublings)[..., None, None]
    block = np.zeros((*times.shape, 2 * n, 2 * n))
    block[..., :n, :n], block[..., n:, n:] = -a * base, a.T * base
    block[..., :n, n:] = q / size
    exponential = short_exponential(block)
    transition = np.swapaxes(exponential[..., n:, n:], -1, -2)
    noise = transition @ exponential[..., :n, n:] * (size * base)
    with np.errstate(over="ignore", invalid="ignore"):
        for level in range(int(doublings.max(initial=0))):
            on = (doublings > level)[..., None, None]
            noise = np.where(on, transition @ noise @ np.swapaxes(transition, -1, -2) + noise, noise)
            transition = np.where(on, transition @ transition, transition)
    return Discrete(transition, 0.5 * (noise + np.swapaxes(noise, -1, -2)))


def integral(a: Array, times: Array) -> Array:
    """The integral of `exp(A s)` from 0 to each time, shape (..., n, n)."""
    n = len(a)
    doublings = doublings_for(norm_or_one(a), times)
    base = (times / 2.0**doublings)[..., None, None]
    block = np.zeros((*times.shape, 2 * n, 2 * n))
    block[..., :n, :n], block[..., :n, n:] = a * base, np.eye(n)
    exponential = short_exponential(block)
    transition, summed = exponential[..., :n, :n], exponential[..., :n, n:] * base
    with np.errstate(over="ignore", invalid="ignore"):
        for level in range(int(doublings.max(initial=0))):
            on = (doublings > level)[..., None, None]
            summed = np.where(on, transition @ summed + summed, summed)
            transition = np.where(on, transition @ transition, transition)
    return np.asarray(summed)


def norm_or_one(matrix: Array) -> float:
    """The Frobenius norm; 1 for a zero matrix."""
    return float(np.linalg.norm(matrix)) or 1.0


def short_exponential(matrix: Array) -> Array:
    """The exponential of matrices of norm 2 at most, by its series: faster than `scipy.linalg.expm` at this size."""
    term = np.eye(matrix.shape[-1])
    total = np.broadcast_to(term, matrix.shape).copy()
    for order in range(1, _TERMS + 1):
        term = term @ matrix / order
        total += term
    return total


def doublings_for(rate: float, times: Array) -> NDArray[np.int64]:
    """Number of halvings of each time until `rate time <= 1`, for which the exponential is well conditioned."""
    return np.maximum(np.ceil(np.log2(np.maximum(rate * times, 1.0))), 0.0).astype(np.int64)
