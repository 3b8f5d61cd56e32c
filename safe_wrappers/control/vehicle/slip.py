"""Longitudinal slip of a driven wheel: the slip ratio, and the wheel speeds that keep it within a limit.

Speeds are signed along the wheel's heading: the circumferential speed `r w` and the ground speed `v_x` of the wheel's
centre. Slip is positive when the wheel is faster than the ground, and normalised: 1 is a wheel that spins on the spot
and -1 a locked one.

Source: appendix "Wheel slip ratio and friction boundaries".
"""

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, finite_arrays, positive
from safe_wrappers.errors import ConfigurationError


def slip_ratio(wheel_speed: ArrayLike, ground_speed: ArrayLike, regularization: float) -> Array:
    """Normalised slip `(r w - v) / max(|v|, |r w|, regularization)`, in size at most 1 (2 in opposite directions).

    Args:
        wheel_speed: r w, m/s, any shape.
        ground_speed: v_x, m/s, broadcast against it.
        regularization: Least denominator, m/s, > 0: near rest the slip is proportional to the sliding speed.
    """
    wheel, ground = finite_arrays(wheel_speed=wheel_speed, ground_speed=ground_speed)
    positive("regularization", regularization, "m/s")
    larger = np.maximum(np.abs(wheel), np.abs(ground))
    return np.asarray((wheel - ground) / np.maximum(larger, regularization))


def slip_window(ground_speed: ArrayLike, max_slip: ArrayLike, regularization: float) -> tuple[Array, Array]:
    """The smallest and largest circumferential speed r w, m/s, whose slip is at most `max_slip` in size.

    Args:
        ground_speed: v_x, m/s, any shape.
        max_slip: In (0, 1), broadcast against it.
        regularization: As in `slip_ratio`, m/s.
    """
    ground, slip = finite_arrays(ground_speed=ground_speed, max_slip=max_slip)
    positive("regularization", regularization, "m/s")
    if not ((slip > 0.0) & (slip < 1.0)).all():
        raise ConfigurationError(f"max_slip is a normalised slip ratio in (0, 1), got {max_slip!r}")
    return -_fastest(-ground, slip, regularization), _fastest(ground, slip, regularization)


def _fastest(ground: Array, slip: Array, floor: float) -> Array:
    braking_or_slow = ground + slip * np.maximum(np.abs(ground), floor)
    return np.asarray(np.where(ground > floor * (1.0 - slip), ground / (1.0 - slip), braking_or_slow))
