"""Covariance over a stretch of time, exactly: the Lyapunov and the Riccati equation by block matrix exponentials.

The exponential is taken over a stretch so short that it is well conditioned; doubling leads from there to the full
time. Nothing is checked here: `safe_wrappers.control.estimation.covariance` does that. What overflows is not finite.

Source: Van Loan, "Computing integrals involving the matrix exponential" (1978); Anderson and Moore, "Optimal
Filtering" (1979), section 6.7, for doubling.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_TERMS = 24
"""Terms of the exponential's series: for matrices of norm 2 the first one left out is below 1e-17."""


class Discrete(NamedTuple):
    """x -> F x plus noise of covariance Q_d: the system over one step of time.

    Attributes:
        transition: F = exp(A t), shape (..., n, n).
        noise: Q_d, symmetric, shape (..., n, n).
    """

    transition: Array
    noise: Array


def van_loan(a: Array, q: Array, times: Array) -> Discrete:
    """`discretise` without its checks; what overflows is not finite."""
    n = len(a)
    size = norm_or_one(q)
    doublings = _doublings(norm_or_one(a), times)
    base = (times / 2.0**doublings)[..., None, None]
    block = np.zeros((*times.shape, 2 * n, 2 * n))
    block[..., :n, :n], block[..., n:, n:] = -a * base, a.T * base
    block[..., :n, n:] = q / size
    exponential = _short_exponential(block)
    transition = np.swapaxes(exponential[..., n:, n:], -1, -2)
    noise = transition @ exponential[..., :n, n:] * (size * base)
    with np.errstate(over="ignore", invalid="ignore"):
        for level in range(int(doublings.max(initial=0))):
            on = (doublings > level)[..., None, None]
            noise = np.where(on, transition @ noise @ np.swapaxes(transition, -1, -2) + noise, noise)
            transition = np.where(on, transition @ transition, transition)
    return Discrete(transition, 0.5 * (noise + np.swapaxes(noise, -1, -2)))


def integral(a: Array, times: Array) -> Array:
    """The integral of `exp(A s)` from 0 to each time, shape (..., n, n); what overflows is not finite."""
    n = len(a)
    doublings = _doublings(norm_or_one(a), times)
    base = (times / 2.0**doublings)[..., None, None]
    block = np.zeros((*times.shape, 2 * n, 2 * n))
    block[..., :n, :n], block[..., :n, n:] = a * base, np.eye(n)
    exponential = _short_exponential(block)
    transition, summed = exponential[..., :n, :n], exponential[..., :n, n:] * base
    with np.errstate(over="ignore", invalid="ignore"):
        for level in range(int(doublings.max(initial=0))):
            on = (doublings > level)[..., None, None]
            summed = np.where(on, transition @ summed + summed, summed)
            transition = np.where(on, transition @ transition, transition)
    return np.asarray(summed)


def riccati_flow(start: Array, a: Array, q: Array, information: Array, time: float) -> Array:
    """P(t) of the Riccati equation: P -> Q_t + E P (I + G P)^-1 E', with E, Q_t, G by doubling.

    Over a short time they are the blocks of the Hamiltonian's exponential. Two equal steps in a row are one of the
    same form, in which only sums and products of positive semidefinite matrices occur.
    """
    unit = math.sqrt(norm_or_one(q) / norm_or_one(information))
    hamiltonian = np.block([[a, q / unit], [information * unit, -a.T]])
    doublings = int(_doublings(norm_or_one(hamiltonian), np.asarray(time)))
    exponential = _short_exponential(hamiltonian * (time / 2.0**doublings))
    n = len(a)
    transition = np.linalg.inv(exponential[n:, n:]).T
    noise, seen = exponential[:n, n:] @ transition.T, transition.T @ exponential[n:, :n]
    # An unstable mode that no noise reaches grows in all three and cancels only in P: beyond this, steps are taken.
    while doublings > 0 and np.abs(np.linalg.eigvals(transition)).max() < 1e4:
        doublings -= 1
        between = np.linalg.inv(np.eye(n) + noise @ seen)
        noise, seen, transition = (
            noise + transition @ between @ noise @ transition.T,
            seen + transition.T @ seen @ between @ transition,
            transition @ between @ transition,
        )
        noise, seen = 0.5 * (noise + noise.T), 0.5 * (seen + seen.T)
    now = start / unit
    for _ in range(2**doublings):
        values, vectors = np.linalg.eigh(now)
        root = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
        turned = np.swapaxes(root, -1, -2)
        moved = transition @ root @ np.linalg.solve(np.eye(n) + turned @ seen @ root, turned) @ transition.T
        later = noise + moved
        later = 0.5 * (later + np.swapaxes(later, -1, -2))
        if np.array_equal(later, now) or not np.isfinite(later).all():
            return np.asarray(later * unit)  # at rest, bit for bit, for good; or out of range
        now = later
    return np.asarray(now * unit)


def norm_or_one(matrix: Array) -> float:
    """Its Frobenius norm; 1 for a zero matrix, to divide by."""
    return float(np.linalg.norm(matrix)) or 1.0


def _short_exponential(matrix: Array) -> Array:
    """The exponential of matrices of norm 2 at most, by its series.

    `scipy.linalg.expm` waits for the threads of its BLAS even for a 4 x 4 matrix: milliseconds on a busy machine.
    """
    term = np.eye(matrix.shape[-1])
    total = np.broadcast_to(term, matrix.shape).copy()
    for order in range(1, _TERMS + 1):
        term = term @ matrix / order
        total += term
    return total


def _doublings(rate: float, times: Array) -> NDArray[np.int64]:
    """How often each time is halved until `rate time <= 1`, in which the exponential is well conditioned."""
    return np.maximum(np.ceil(np.log2(np.maximum(rate * times, 1.0))), 0.0).astype(np.int64)
