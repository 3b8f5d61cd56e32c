"""Driven wheels: their slip, the force of the ground, and the peak of the traction curve.

Speeds are signed along the wheel's heading: the circumferential speed `r w` and the ground speed `v_x` of the wheel's
centre. Slip is positive when the wheel is faster than the ground, and normalised: 1 is a wheel that spins on the spot
and -1 a locked one.

Source: appendix "Wheel slip ratio and friction boundaries"; the shape of traction curves is the Magic Formula's.
"""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.errors import Array

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


def slip_ratio(wheel_speed: ArrayLike, ground_speed: ArrayLike, regularization: float) -> Array:
    """Normalised slip `(r w - v) / max(|v|, |r w|, regularization)`, in size at most 1 (2 in opposite directions).

    Of speeds in m/s, any shape. The regularization, m/s, > 0, makes slip near rest proportional to the sliding speed.
    """
    wheel, ground = np.asarray(wheel_speed, dtype=np.float64), np.asarray(ground_speed, dtype=np.float64)
    larger = np.maximum(np.abs(wheel), np.abs(ground))
    return np.asarray((wheel - ground) / np.maximum(larger, regularization))


def slip_window(ground_speed: ArrayLike, max_slip: Array, regularization: float) -> tuple[Array, Array]:
    """The least and largest r w, m/s, whose slip is at most `max_slip`, in (0, 1), in size; shape as of v_x, m/s."""
    ground = np.asarray(ground_speed, dtype=np.float64)
    return -_fastest(-ground, max_slip, regularization), _fastest(ground, max_slip, regularization)


def _fastest(ground: Array, slip: Array, floor: float) -> Array:
    braking_or_slow = ground + slip * np.maximum(np.abs(ground), floor)
    return np.asarray(np.where(ground > floor * (1.0 - slip), ground / (1.0 - slip), braking_or_slow))


class Response(NamedTuple):
    """`w+ = decay w + gain (tau - r F)`: share of the rate that remains, and rate per torque, rad/(s N m)."""

    decay: Array
    gain: Array


@dataclass(frozen=True)
class Wheel:
    """Constants of one or more wheels, arrays of one shape.

    Over a control interval `I w' = tau - b w - r F`, with torque and force constant over the interval, stepped with
    implicit damping as MuJoCo's Euler integrators do: `w+ = decay w + gain (tau - r F)`, exactly. Solved for F it is
    a traction-force observer; other torques on the axle (dry friction, a spring) appear in F.
    """

    radius: Array  #: r, m, > 0
    inertia: Array  #: I about the axle, rotor included, kg m^2, > 0
    damping: Array  #: b of the axle, N m s/rad, >= 0

    def response(self, timestep: float, substeps: int) -> Response:
        """To torque and force held for `substeps` physics steps of `timestep` s."""
        effective = self.inertia + timestep * self.damping
        share = self.inertia / effective
        # (1 - decay) / b, also where b is 0.
        gain = timestep / effective * sum(share**step for step in range(substeps))
        return Response(share**substeps, np.asarray(gain))

    def traction(self, response: Response, before: Array, after: Array, torque: Array) -> Array:
        """The ground's mean force F over an interval, N, from the rates (rad/s) around it and the torque (N m)."""
        return np.asarray((torque - (after - response.decay * before) / response.gain) / self.radius)


class FrictionEstimate:
    """Online estimate of the traction curve's peak under each of n wheels: its height, its slip, their uncertainty.

    There is a hypothesis per slip of the peak, with a Kalman filter of the peak's height, weighted by its likelihood.
    Height and weights fade with the distance travelled; a measurement that no hypothesis explains resets them. The
    standard deviation holds for white noise and curves of this shape: it is no error bound.
    """

    def __init__(self, wheels: int) -> None:
        self._peaks = np.array(PEAK_SLIPS)
        self._stretch = math.tan(math.pi / (2.0 * _SHAPE)) / self._peaks
        self._height = np.full((wheels, self._peaks.size), _PRIOR_MEAN)
        self._variance = np.full((wheels, self._peaks.size), _PRIOR_STD**2)
        self._log_weight = np.zeros((wheels, self._peaks.size))  # the largest is 0

    @property
    def weights(self) -> Array:
        """Probability of each hypothesis in `PEAK_SLIPS`, shape (n, k)."""
        weight = np.exp(self._log_weight - self._log_weight.max(axis=1, keepdims=True))
        return np.asarray(weight / weight.sum(axis=1, keepdims=True))

    @property
    def mean(self) -> Array:
        """Peak friction coefficient, shape (n,)."""
        return np.asarray((self.weights * self._height).sum(axis=1))

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
        self._variance[strange], self._log_weight[strange] = _PRIOR_STD**2, 0.0
        expected = shape**2 * self._variance + noise
        gain = np.where(known, self._variance * shape / expected, 0.0)
        self._height = self._height + gain * residual
        self._variance = self._variance * (1.0 - gain * shape)
        self._log_weight -= np.where(known, 0.5 * (residual**2 / expected + np.log(expected)), 0.0)
        self._log_weight -= self._log_weight.max(axis=1, keepdims=True)
