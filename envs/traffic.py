"""The cars' motion: a speed that wanders about its mean, drawn without a discretisation error."""

import math
from typing import Final

import numpy as np

from safe_wrappers.errors import Array

CAR_MEAN_SPEED: Final = 1.0
"""m/s, along the lane."""
CAR_TIME_CONSTANT_S: Final = 2.0
"""How long a car's speed takes to come back to its mean but for 1/e."""
CAR_SPEED_STD: Final = 0.15
"""Stationary standard deviation of a car's speed, m/s."""
CAR_ACCELERATION_NOISE: Final = 2.0 * CAR_SPEED_STD**2 / CAR_TIME_CONSTANT_S
"""Intensity of the white noise in a car's acceleration, m^2/s^3."""


class Traffic:
    """Cars with ``p' = v``, ``v' = -(v - mean) / CAR_TIME_CONSTANT_S + w``, independent of each other.

    `w` is white noise of intensity `CAR_ACCELERATION_NOISE` (an Ornstein-Uhlenbeck process). Over a step, position
    and velocity are drawn from their joint normal distribution given the state before, so their distribution does
    not depend on how short the steps are. Several steps are drawn at once, from the same random numbers as one by
    one.

    Args:
        mean_velocities: Along the world's x, shape (n,), m/s.
        step_s: Time between two drawn states.
        steps: States to draw at a time.
    """

    def __init__(self, mean_velocities: Array, step_s: float, steps: int) -> None:
        flow = transition(step_s)
        root = np.linalg.cholesky(noise_covariance(step_s))
        powers = [np.eye(2)]
        for _ in range(steps):
            powers.append(flow @ powers[-1])
        # Of all states at once: what the first state, the noises and the means make of them.
        self._from_state = np.concatenate(powers[1:])
        self._from_noise = np.zeros((2 * steps, 2 * steps))
        for k in range(steps):
            for j in range(k + 1):
                self._from_noise[2 * k : 2 * k + 2, 2 * j : 2 * j + 2] = powers[k - j] @ root
        times = step_s * np.arange(1, steps + 1)
        fixed = np.stack([times, np.ones(steps)], axis=1) - self._from_state[:, 1].reshape(steps, 2)
        self._from_means = fixed.reshape(-1, 1) * mean_velocities
        self.step_s = step_s
        self.steps = steps

    def drive(self, rng: np.random.Generator, positions: Array, velocities: Array) -> Array:
        """Draw positions and velocities at the ends of the next steps, shape (steps, 2, n), from those now, (n,)."""
        noise = rng.standard_normal((2 * self.steps, len(positions)))
        states = self._from_state @ np.stack([positions, velocities])
        states += self._from_noise @ noise
        states += self._from_means
        drawn: Array = states.reshape(self.steps, 2, -1)
        return drawn


def transition(time_s: float) -> Array:
    """How the deviation of (position, velocity) from a drive at the mean velocity goes on, shape (2, 2)."""
    kept = math.exp(-time_s / CAR_TIME_CONSTANT_S)
    return np.array([[1.0, -CAR_TIME_CONSTANT_S * math.expm1(-time_s / CAR_TIME_CONSTANT_S)], [0.0, kept]])


def noise_covariance(time_s: float) -> Array:
    """Covariance of (position, velocity) that the noise of a time adds, shape (2, 2), in m and s.

    Differences of nearly equal numbers: for times from a millisecond on, its relative error is below 1e-8.
    """
    tau, q = CAR_TIME_CONSTANT_S, CAR_ACCELERATION_NOISE
    lost, twice_lost = -math.expm1(-time_s / tau), -math.expm1(-2.0 * time_s / tau)
    position = q * tau**2 * (time_s - 2.0 * tau * lost + 0.5 * tau * twice_lost)
    both = 0.5 * q * tau**2 * lost**2
    return np.array([[position, both], [both, 0.5 * q * tau * twice_lost]])
