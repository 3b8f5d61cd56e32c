"""Coordinated turns: the motion of something whose velocity turns at a rate of its own, and its sensitivities.

In the plane, with the velocity as a complex number v = v_x + i v_y,

    p' = v,    v' = i omega v + (mean_velocity - v) / reversion_s + w_v,    omega' = w_omega.

It is nonlinear in (v, omega). Without noise omega stays, and what is left is linear in v: position, velocity and
their derivatives by the state before are integrals of exp((i omega - 1 / reversion_s) s), exact but for rounding. At
v = mean_velocity = 0 nothing depends on omega.

Source: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), the
nearly-coordinated-turn model.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array

Complex = NDArray[np.complex128]

SIZE: Final = 5
"""Of a state: x, y (m), v_x, v_y (m/s), omega (rad/s, positive to the left)."""
RADIANS_AT_ONCE: Final = 2.0
"""A time up to this over |i omega - 1 / reversion_s| is integrated in one go, exact to 1e-12."""

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
_SHARES, _PARTS = 0.5 * (_NODES + 1.0), 0.5 * _WEIGHTS
"""Gauss's nodes and weights on (0, 1)."""


class Turns(NamedTuple):
    """Motion models of n things.

    Attributes:
        intensity: Of the acceleration noise w_v, shape (n, 2, 2), m^2/s^3.
        turn_noise: Of w_omega, shape (n,), rad^2/s^3.
        rate: 1 / reversion_s, shape (n,), 1/s.
        mean_velocity: Shape (n, 2), m/s.
    """

    intensity: Array
    turn_noise: Array
    rate: Array
    mean_velocity: Array

    def longest_s(self, state: Array) -> float:
        """The longest time that is integrated in one go from states (n, 5), s."""
        fastest = float(np.hypot(self.rate, state[:, 4]).max())
        return RADIANS_AT_ONCE / fastest if fastest > 0.0 else np.inf


class Flow(NamedTuple):
    """Where states go, and how that depends on where they came from."""

    state: Array
    """Shape (..., n, 5)."""
    jacobian: Array
    """Of the state by the state before, shape (..., n, 5, 5)."""


def flow(turns: Turns, state: Array, time_s: Array) -> Flow:
    """States after a time without noise.

    Args:
        turns: Of n things.
        state: Shape (..., n, 5).
        time_s: Shape (...), each at most `turns.longest_s(state)`.
    """
    t = np.asarray(time_s, dtype=np.float64)[..., None]
    turning = 1j * state[..., 4] - turns.rate
    s = t[..., None] * _SHARES
    growth = np.exp(turning[..., None] * s)
    weights = t[..., None] * _PARTS
    left = t[..., None] - s

    def integral(factor: Any) -> Complex:
        return np.asarray((weights * factor * growth).sum(axis=-1))

    whole, once, twice = np.exp(turning * t), integral(1.0), integral(left)
    # Derivatives by omega; that of exp(i omega s) is i s exp(i omega s).
    by_whole, by_once, by_twice = 1j * t * whole, 1j * integral(s), 1j * integral(left * s)
    velocity = state[..., 2] + 1j * state[..., 3]
    pull = turns.rate * (turns.mean_velocity[..., 0] + 1j * turns.mean_velocity[..., 1])
    moved, after = once * velocity + twice * pull, whole * velocity + once * pull
    by_omega = by_once * velocity + by_twice * pull, by_whole * velocity + by_once * pull
    new, jacobian = np.empty(state.shape), np.empty((*state.shape, SIZE))
    new[..., 0], new[..., 1] = state[..., 0] + moved.real, state[..., 1] + moved.imag
    new[..., 2], new[..., 3], new[..., 4] = after.real, after.imag, state[..., 4]
    jacobian[...] = np.eye(SIZE)
    for row, factor in ((0, once), (2, whole)):
        jacobian[..., row, 2] = jacobian[..., row + 1, 3] = factor.real
        jacobian[..., row + 1, 2], jacobian[..., row, 3] = factor.imag, -factor.imag
    for row, slope in zip((0, 2), by_omega, strict=True):
        jacobian[..., row, 4], jacobian[..., row + 1, 4] = slope.real, slope.imag
    return Flow(new, jacobian)


def gathered_noise(turns: Turns, state: Array, time_s: Array) -> Array:
    """Covariance that the noises add over times (k,) to things that start in states (n, 5), shape (k, n, 5, 5).

    To first order: each noise is carried on by the sensitivities along the way without noise.
    """
    into = np.zeros((len(state), 3, 3))
    into[:, :2, :2], into[:, 2, 2] = turns.intensity, turns.turn_noise
    times = np.asarray(time_s, dtype=np.float64)
    begun = times * _SHARES[:, None]  # (nodes, k)
    there = flow(turns, np.broadcast_to(state, (*begun.shape, *state.shape)), begun).state
    carried = flow(turns, there, times - begun).jacobian[..., 2:]
    weights = (times * _PARTS[:, None])[..., None, None, None]
    return np.asarray((weights * (carried @ into @ carried.swapaxes(-1, -2))).sum(axis=0))


def rates(turns: Turns, which: int, state: NDArray[Any]) -> NDArray[Any]:
    """X' of one thing in a state (5,), as `lie_derivatives` runs it: without noise, of numbers or Taylor series."""
    _, _, vx, vy, omega = state
    mean_x, mean_y = turns.mean_velocity[which]
    rate = float(turns.rate[which])
    return np.array(
        [vx, vy, rate * (mean_x - vx) - omega * vy, rate * (mean_y - vy) + omega * vx, 0.0 * omega],
        dtype=object,
    )
