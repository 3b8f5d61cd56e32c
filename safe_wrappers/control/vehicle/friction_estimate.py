"""Online estimate of a traction curve's peak: its height, its slip, and their uncertainty.

There is a hypothesis per slip of the peak, with a Kalman filter of the peak's height, weighted by its likelihood.
Height and weights fade with the distance travelled; a measurement that no hypothesis explains resets them.

Source: appendix "Wheel slip ratio and friction boundaries"; the curve's shape is the Magic Formula's. The standard
deviations hold for white noise and curves of this shape: they are no error bound.
"""

import copy
import math
from typing import Final

import numpy as np

from safe_wrappers.checks import Array

PEAK_SLIPS: Final = (0.05, 0.07, 0.09, 0.11, 0.13, 0.15, 0.18, 0.22)
"""Slips of the peak, one per hypothesis."""
_SHAPE: Final = 1.65
_PRIOR_MEAN, _PRIOR_STD = 0.5, 0.5
_DRIFT: Final = 0.1
"""Standard deviation that a metre of travel adds to the height."""
_MEMORY_M: Final = 5.0
"""Metres after which the hypotheses' log-weights have faded to 1/e."""
_SURPRISE: Final = 4.0
"""Standard deviations beyond which a measurement resets the estimate."""


class FrictionEstimate:
    """Peak friction under each of n wheels."""

    def __init__(self, wheels: int) -> None:
        peaks = np.array(PEAK_SLIPS)
        self._stretch = math.tan(math.pi / (2.0 * _SHAPE)) / peaks
        self._peaks = peaks
        self._height = np.full((wheels, peaks.size), _PRIOR_MEAN)
        self._variance = np.full((wheels, peaks.size), _PRIOR_STD**2)
        self._log_weight = np.zeros((wheels, peaks.size))
        self._weights: Array | None = None

    def copy(self) -> "FrictionEstimate":
        """One that goes on from here by itself."""
        other = copy.copy(self)
        other._variance, other._log_weight = self._variance.copy(), self._log_weight.copy()
        return other

    @property
    def weights(self) -> Array:
        """Probability of each hypothesis in `PEAK_SLIPS`, shape (n, k)."""
        if self._weights is None:
            weight = np.exp(self._log_weight - self._log_weight.max(axis=1, keepdims=True))
            self._weights = weight / weight.sum(axis=1, keepdims=True)
        return self._weights

    @property
    def mean(self) -> Array:
        """Peak friction coefficient, shape (n,)."""
        return np.asarray((self.weights * self._height).sum(axis=1))

    @property
    def std(self) -> Array:
        """Its standard deviation, shape (n,): within the hypotheses and between them."""
        weights = self.weights
        mean = (weights * self._height).sum(axis=1, keepdims=True)
        return np.asarray(np.sqrt((weights * (self._variance + (self._height - mean) ** 2)).sum(axis=1)))

    @property
    def peak_slip(self) -> tuple[Array, Array]:
        """Mean and standard deviation of the slip at the peak, shapes (n,)."""
        weights = self.weights
        mean = (weights * self._peaks).sum(axis=1)
        return mean, np.sqrt((weights * (self._peaks - mean[:, None]) ** 2).sum(axis=1))

    def rise(self, start: Array, end: Array) -> Array:
        """Friction at one slip over friction at another, both >= 0 and shape (n,); 1 between two slips of zero."""
        weights = self.weights
        first, last = ((weights * self._shape(slip)).sum(axis=1) for slip in (start, end))
        return np.asarray(np.where(first > 0.0, last / np.where(first > 0.0, first, 1.0), 1.0))

    def _shape(self, slip: Array) -> Array:
        return np.asarray(np.sin(_SHAPE * np.arctan(np.abs(slip)[:, None] * self._stretch)))

    def travel(self, distance: Array) -> None:
        """Fade the estimate over distances travelled, shape (n,), m, >= 0."""
        self._variance = np.minimum(self._variance + (_DRIFT**2 * distance)[:, None], _PRIOR_STD**2)
        self._log_weight *= np.exp(-distance / _MEMORY_M)[:, None]
        self._weights = None

    def update(self, slip: Array, friction: Array, noise_std: Array) -> None:
        """Take one measurement per wheel.

        Args:
            slip: Size of the normalised slip, shape (n,).
            friction: Size of force over load, shape (n,).
            noise_std: Of the friction, shape (n,), > 0; infinite where a wheel has no measurement.
        """
        shape, noise = self._shape(slip), (noise_std**2)[:, None]
        known = np.isfinite(noise)
        residual = np.where(known, friction[:, None] - shape * self._height, 0.0)
        noise = np.where(known, noise, 1.0)
        expected = shape**2 * self._variance + noise
        strange = known[:, 0] & (residual**2 > _SURPRISE**2 * expected).all(axis=1)
        if strange.any():
            self._variance[strange] = _PRIOR_STD**2
            self._log_weight[strange] = 0.0
            expected = shape**2 * self._variance + noise
        gain = np.where(known, self._variance * shape / expected, 0.0)
        self._height = self._height + gain * residual
        self._variance = self._variance * (1.0 - gain * shape)
        self._log_weight -= np.where(known, 0.5 * (residual**2 / expected + np.log(expected)), 0.0)
        self._log_weight -= self._log_weight.max(axis=1, keepdims=True)
        self._weights = None
