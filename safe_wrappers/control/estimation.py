"""Estimates with and without measurements: covariance, tracks of moving objects, and what outputs never show.

A linear system x' = A x + b + w has white noise of the *intensity* Q (covariance kernel Q delta(t - s)), in units of
x^2 / s. Without measurements the covariance follows the Lyapunov equation P' = A P + P A' + Q, exactly from step to
step; a measurement is a Kalman update of Joseph's form: symmetric and positive semidefinite for any gain, rounding
included.

An initial error in an unobservable direction never shows in the outputs, so no filter corrects it. Full rank says
that the state can be determined from ideal outputs, not how accurately or how soon. Of a linear system the Lie
derivatives of the outputs are C A^k x, so that this is their rank test, too.

Source: appendix "Continuous Lyapunov and Riccati covariance dynamics" and "Observability rank"; Van Loan (1978) for
the discretisation; Anderson and Moore, "Optimal Filtering" (1979), section 6.7, for doubling; Bar-Shalom, Li,
Kirubarajan, "Estimation with Applications to Tracking and Navigation" (2001), section 5.2.
"""

import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.errors import Array

_KEPT: Final = 256
"""Number of cached discretisations."""
_TOLERANCE: Final = 1e-9
"""Singular values up to this share of the scale count as zero."""


def discretise(
    A: ArrayLike, Q: ArrayLike, time_s: float, b: ArrayLike | None = None
) -> tuple[Array, Array, Array]:
    """The exact step over a time, x -> F x + d plus noise of covariance Q_d: F (n, n), d (n,) and Q_d (n, n).

    A in 1/s and the noise's intensity Q, positive semidefinite, have the shape (n, n), a constant drift b (n,). The
    exponential is taken over a time in which A changes little, where it is well conditioned, and doubled.
    """
    from scipy.linalg import expm  # here: SciPy takes a while to import

    n = len(np.asarray(A))
    a, q = np.zeros((2, n + 1, n + 1))  # of the state and 1, which b multiplies
    a[:n, :n], q[:n, :n] = A, Q
    a[:n, n] = 0.0 if b is None else b
    size = float(np.linalg.norm(q)) or 1.0
    doublings = max(math.ceil(math.log2(max(float(np.linalg.norm(a)) * time_s, 1.0))), 0)
    base = time_s / 2.0**doublings
    exponential = expm(base * np.block([[-a, q / size], [np.zeros_like(a), a.T]]))
    transition = exponential[n + 1 :, n + 1 :].T
    noise = size * (transition @ exponential[: n + 1, n + 1 :])
    for _ in range(doublings):
        noise = transition @ noise @ transition.T + noise
        transition = transition @ transition
    return transition[:n, :n], transition[:n, n], 0.5 * (noise + noise.T)[:n, :n]


def predict(
    mean: Array, cov: Array, transition: Array, noise: Array, drift: Array | float = 0.0
) -> tuple[Array, Array]:
    """Mean (..., n) and covariance (..., n, n) after a step without measurement: `x -> F x + d`, `P -> F P F' + Q_d`.

    The transition F and the noise Q_d have the shape (n, n), or are one per track; d is a known drift in this step.
    """
    moved = (transition @ mean[..., None])[..., 0] + drift
    grown = transition @ cov @ np.swapaxes(transition, -1, -2) + noise
    return moved, 0.5 * (grown + np.swapaxes(grown, -1, -2))


def update(mean: Array, cov: Array, measured: Array, C: Array, R: Array) -> tuple[Array, Array]:
    """Mean (..., n) and covariance (..., n, n) after one measurement `y = C x + v`, shape (..., m), per track.

    C has the shape (m, n), the covariance R of v (not its intensity) is positive definite, shape (m, m); or they are
    one per track.
    """
    cross = cov @ np.swapaxes(C, -1, -2)
    gain = cross @ np.linalg.inv(C @ cross + R)
    innovation = measured - (C @ mean[..., None])[..., 0]
    left = np.eye(cov.shape[-1]) - gain @ C
    kept = left @ cov @ np.swapaxes(left, -1, -2) + gain @ R @ np.swapaxes(gain, -1, -2)
    mean = mean + (gain @ innovation[..., None])[..., 0]
    return mean, 0.5 * (kept + np.swapaxes(kept, -1, -2))


class Motion(NamedTuple):
    """Motion model of one track: `p' = v`, `v' = (mean_velocity - v) / reversion_s + w`."""

    intensity: Array  #: of the acceleration noise w, shape (d, d), m^2/s^3
    reversion_s: float  #: time constant with which the velocity reverts to its mean, s; inf for none
    mean_velocity: Array  #: shape (d,), m/s

    def matrices(self) -> tuple[Array, Array, Array]:
        """A (2d, 2d), the constant drift b (2d,) and the noise intensity Q (2d, 2d) of `x' = A x + b + w`."""
        d, rate = self.mean_velocity.size, 1.0 / self.reversion_s
        a, q = np.zeros((2, 2 * d, 2 * d))
        a[:d, d:], a[d:, d:], q[d:, d:] = np.eye(d), -rate * np.eye(d), self.intensity
        return a, np.concatenate([np.zeros(d), rate * self.mean_velocity]), q

    def over(self, time_s: float) -> tuple[Array, Array, Array]:
        """Transition (2d, 2d), drift (2d,) and noise (2d, 2d) over a time."""
        a, b, q = self.matrices()
        return discretise(a, q, time_s, b)


class Tracks:
    """Means and covariances of n tracks, each with the state (position, velocity).

    Args:
        motions: One per track, all of the same number of coordinates d, one to three.

    Attributes:
        size: Of a state: 2d.
        mean: Positions and velocities, shape (n, 2d), m and m/s.
        covariance: Shape (n, 2d, 2d).
    """

    def __init__(self, motions: Sequence[Motion]) -> None:
        self.motions = list(motions)
        self.coordinates = self.motions[0].mean_velocity.size
        self.size = 2 * self.coordinates
        self.mean = np.zeros((len(self.motions), self.size))
        self.covariance = np.zeros((len(self.motions), self.size, self.size))
        self._known: dict[float, tuple[Array, ...]] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Without what is computed again: a pickle stores it in another order, and sums would round otherwise."""
        return vars(self) | {"_known": {}}

    @property
    def positions(self) -> Array:
        """Estimated positions, shape (n, d), m."""
        return self.mean[:, : self.coordinates]

    @property
    def velocities(self) -> Array:
        """Estimated velocities, shape (n, d), m/s."""
        return self.mean[:, self.coordinates :]

    @property
    def position_covariances(self) -> Array:
        """Shape (n, d, d), m^2."""
        return self.covariance[:, : self.coordinates, : self.coordinates]

    def start(self, mean: Array, covariance: Array) -> None:
        """Begin with a prior: shapes (n, 2d) and (n, 2d, 2d)."""
        self.mean = np.array(mean, dtype=np.float64)
        self.covariance = np.array(covariance, dtype=np.float64)

    def advance(self, time_s: float) -> None:
        """Predict over a time without measurements."""
        transition, drift, noise = self._over(time_s)
        self.mean, self.covariance = predict(self.mean, self.covariance, transition, noise, drift)

    def see(self, which: NDArray[np.intp], measured: Array, matrix: Array, noise: Array) -> None:
        """Update tracks (indices, shape (k,)) with measurements (k, m), with one C (m, 2d) and R (m, m) for all."""
        before = self.mean[which], self.covariance[which]
        self.mean[which], self.covariance[which] = update(*before, measured, matrix, noise)

    def ahead(self, times_s: Sequence[float]) -> tuple[Array, Array]:
        """Positions (k, n, d), m, and covariances (k, n, d, d), m^2, at k times ahead without measurements."""
        d = self.coordinates
        parts = [(f[:, :d], b[:, :d], q[:, :d, :d]) for f, b, q in map(self._over, times_s)]
        transition, drift, noise = (np.stack(part) for part in zip(*parts, strict=True))
        positions = (transition @ self.mean[:, :, None])[..., 0] + drift
        return positions, transition @ self.covariance @ transition.swapaxes(-1, -2) + noise

    def _over(self, time_s: float) -> tuple[Array, ...]:
        """Transition, drift and noise of all tracks over a time."""
        if time_s not in self._known:
            if len(self._known) >= _KEPT:
                self._known.clear()
            parts = zip(*(motion.over(time_s) for motion in self.motions), strict=True)
            self._known[time_s] = tuple(np.stack(part) for part in parts)
        return self._known[time_s]


def largest_deviation(covariances: Array) -> Array:
    """The standard deviation in the direction in which it is largest, shape (...,), of covariances (..., d, d)."""
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(covariances)[..., -1], 0.0)))


def unobservable_subspace(a: Array, c: Array) -> Array:
    """Orthonormal basis of what outputs C x of x' = A x never show, shape (n, n - rank); A and C of a size near 1.

    The largest subspace in the kernel of C that A maps into itself, by orthogonal projections: no powers of A, whose
    fast modes would hide the slow ones.
    """
    basis, seen = np.eye(len(a)), c
    while basis.shape[1]:
        _, values, axes = np.linalg.svd(seen)
        rank = int((values > _TOLERANCE).sum())
        if rank == 0:
            break
        basis = basis @ axes[rank:].T
        moved = a @ basis
        seen = moved - basis @ (basis.T @ moved)
    return np.asarray(basis)


def unobservable_states(A: ArrayLike, C: ArrayLike, names: Sequence[str]) -> tuple[str, ...]:
    """The states that the outputs C x of x' = A x do not determine: those in some unobservable direction.

    Args:
        A: Shape (n, n), 1/s.
        C: Shape (m, n); a row of zeros measures nothing.
        names: Of the n states, in comparable units.

    >>> # A position that is measured, and a bias on a velocity that is not:
    >>> unobservable_states([[0, 1, 1], [0, 0, 0], [0, 0, 0]], [[1, 0, 0]], names=("x", "v", "bias"))
    ('v', 'bias')
    """
    a, c = np.asarray(A, dtype=np.float64), np.asarray(C, dtype=np.float64)
    lengths = np.linalg.norm(c, axis=1, keepdims=True)
    basis = unobservable_subspace(
        a / (np.linalg.norm(a, 2) or 1.0), c / np.where(lengths > 0.0, lengths, 1.0)
    )
    return tuple(name for name, row in zip(names, basis, strict=True) if np.linalg.norm(row) > 1e-8)
