"""Tracks of several moving objects, measured or not: means, covariances and predictions.

Each track has the state (position, velocity), of one, two or three coordinates each, with

    p' = v,    v' = (mean_velocity - v) / reversion_s + w,    E[w(t) w(s)'] = q delta(t - s).

Between measurements the covariance follows the Lyapunov equation, exactly; a measurement is a Kalman update of
Joseph's form: symmetric and positive semidefinite for any gain, rounding included.

Source: appendix "Continuous Lyapunov and Riccati covariance dynamics"; Bar-Shalom, Li, Kirubarajan, "Estimation with
Applications to Tracking and Navigation" (2001), section 5.2.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array
from safe_wrappers.control.estimation.covariance import discretise, discretise_drift

_KEPT = 256
"""Number of cached discretisations."""


def predict(
    mean: Array, cov: Array, transition: Array, noise: Array, drift: Array | None = None
) -> tuple[Array, Array]:
    """Mean and covariance after one step without a measurement: `x -> F x + d`, `P -> F P F' + Q_d`.

    Args:
        mean: Estimate, shape (..., n).
        cov: Its covariance, shape (..., n, n).
        transition: F, shape (n, n), or one per track.
        noise: Q_d, shape (n, n), or one per track.
        drift: d, known displacement in this step, shape (n,) or (..., n); None for none.
    """
    moved = (transition @ mean[..., None])[..., 0]
    if drift is not None:
        moved += drift
    grown = transition @ cov @ np.swapaxes(transition, -1, -2)
    grown += noise
    return moved, 0.5 * (grown + np.swapaxes(grown, -1, -2))


def update(mean: Array, cov: Array, measured: Array, C: Array, R: Array) -> tuple[Array, Array]:
    """Mean and covariance after one measurement `y = C x + v` per track.

    Args:
        mean: Estimate, shape (..., n).
        cov: Its covariance, shape (..., n, n).
        measured: y, shape (..., m).
        C: Measurement matrix, shape (m, n), or one per track.
        R: Covariance of v (not its intensity), positive definite, shape (m, m), or one per track.
    """
    Ct = np.swapaxes(C, -1, -2)
    cross = cov @ Ct
    innovation_cov = C @ cross
    innovation_cov += R
    gain = cross @ np.linalg.inv(innovation_cov)
    innovation = measured - (C @ mean[..., None])[..., 0]
    left = gain @ C
    np.negative(left, out=left)
    np.einsum("...ii->...i", left)[...] += 1.0
    kept = left @ cov @ np.swapaxes(left, -1, -2)
    kept += gain @ R @ np.swapaxes(gain, -1, -2)
    mean = mean + (gain @ innovation[..., None])[..., 0]
    return mean, 0.5 * (kept + np.swapaxes(kept, -1, -2))


class Motion(NamedTuple):
    """Motion model of one track.

    Attributes:
        intensity: Of the acceleration noise, q, shape (d, d), m^2/s^3.
        reversion_s: Time constant with which the velocity reverts to its mean, s; inf for none.
        mean_velocity: Shape (d,), m/s.
    """

    intensity: Array
    reversion_s: float
    mean_velocity: Array

    def matrices(self) -> tuple[Array, Array, Array]:
        """A (2d, 2d), the constant drift b (2d,) and the noise intensity Q (2d, 2d) of `x' = A x + b + w`."""
        d, rate = self.mean_velocity.size, 1.0 / self.reversion_s
        a, q = np.zeros((2 * d, 2 * d)), np.zeros((2 * d, 2 * d))
        a[:d, d:] = np.eye(d)
        a[d:, d:] = -rate * np.eye(d)
        q[d:, d:] = self.intensity
        return a, np.concatenate([np.zeros(d), rate * self.mean_velocity]), q


class _Over(NamedTuple):
    """Exact discretisation of all tracks over a time."""

    transition: Array
    drift: Array
    noise: Array


class Tracks:
    """Means and covariances of n tracks.

    Args:
        motions: One per track, all of the same number of coordinates.

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
        self._known: dict[float, _Over] = {}

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
        return self.mean[:, self.coordinates : 2 * self.coordinates]

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
        """Update some tracks with measurements.

        Args:
            which: Their indices, shape (k,).
            measured: Shape (k, m).
            matrix: C of all of them, shape (m, 2d).
            noise: Covariance R of all of them, shape (m, m).
        """
        before = self.mean[which], self.covariance[which]
        self.mean[which], self.covariance[which] = update(*before, measured, matrix, noise)

    def ahead(self, times_s: Sequence[float]) -> tuple[Array, Array]:
        """Positions (k, n, d), m, and covariances (k, n, d, d), m^2, at k times ahead without measurements."""
        d = self.coordinates
        parts = [(f[:, :d], b[:, :d], q[:, :d, :d]) for f, b, q in map(self._over, times_s)]
        transition, drift, noise = (np.stack(part) for part in zip(*parts, strict=True))
        positions = (transition @ self.mean[:, :, None])[..., 0] + drift
        return positions, transition @ self.covariance @ transition.swapaxes(-1, -2) + noise

    def _over(self, time_s: float) -> _Over:
        over = self._known.get(time_s)
        if over is None:
            each: dict[int, tuple[Array, Array, Array]] = {}
            for motion in self.motions:
                if id(motion) not in each:
                    a, b, q = motion.matrices()
                    transition, noise = discretise(a, q, time_s)
                    each[id(motion)] = transition, discretise_drift(a, b, time_s), noise
            parts = [each[id(motion)] for motion in self.motions]
            over = _Over(*(np.stack(part) for part in zip(*parts, strict=True)))
            if len(self._known) >= _KEPT:
                self._known.clear()
            self._known[time_s] = over
        return over


def largest_deviation(covariances: Array) -> Array:
    """The standard deviation in the direction in which it is largest, shape (...,), of covariances (..., d, d)."""
    if covariances.shape[-1] == 2:
        a, b, c = covariances[..., 0, 0], covariances[..., 0, 1], covariances[..., 1, 1]
        largest = np.asarray(0.5 * (a + c) + np.hypot(0.5 * (a - c), b))
    else:
        largest = np.asarray(np.linalg.eigvalsh(covariances)[..., -1])
    return np.asarray(np.sqrt(np.maximum(largest, 0.0)))
