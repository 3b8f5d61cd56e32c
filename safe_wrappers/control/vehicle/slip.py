"""Longitudinal slip of a driven wheel, the wheel speeds that keep it within a limit, and the wheel in between.

Speeds are signed along the wheel's heading: the circumferential speed `r w` and the ground speed `v_x` of the wheel's
centre. Slip is positive when the wheel is faster than the ground, and normalised: 1 is a wheel that spins on the spot
and -1 a locked one.

Over a control interval `I w' = tau - k w - b w - r F`, with torque and force constant over the interval and k the
feedback of a speed servo, stepped with implicit damping as MuJoCo's Euler integrators do: `w+ = decay w + gain (tau -
r F)`, exactly. Solved for F it is a traction-force observer; other torques on the axle (dry friction, a spring)
appear in F.

Source: appendix "Wheel slip ratio and friction boundaries".
"""

from dataclasses import dataclass
from typing import NamedTuple

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


class Response(NamedTuple):
    """`w+ = decay w + gain (tau - r F)`: share of the rate that remains, and rate per torque, rad/(s N m)."""

    decay: Array
    gain: Array


@dataclass(frozen=True)
class Wheel:
    """Constants of one or more wheels, arrays of one shape.

    Attributes:
        radius: r, m, > 0.
        inertia: I about the axle, rotor included, kg m^2, > 0.
        damping: b of the axle, N m s/rad, >= 0.
    """

    radius: Array
    inertia: Array
    damping: Array

    def response(
        self, timestep: float, substeps: int, feedback: Array | float = 0.0, implicit: bool = False
    ) -> Response:
        """To torque and force held for `substeps` physics steps of `timestep` s.

        Args:
            timestep: s.
            substeps: Of one control interval.
            feedback: k of speed servos, N m s/rad; `torque` is then their torque at standstill.
            implicit: Whether the engine integrates the feedback implicitly, like damping.
        """
        k = np.asarray(feedback, dtype=np.float64)
        effective = self.inertia + timestep * (self.damping + (k if implicit else 0.0))
        share = (self.inertia - (0.0 if implicit else timestep * k)) / effective
        decay = share**substeps
        # (1 - decay) / (b + k), also where both are 0.
        gain = timestep / effective * sum(share**step for step in range(substeps))
        return Response(decay, np.asarray(gain))

    def traction(self, response: Response, before: Array, after: Array, torque: Array) -> Array:
        """The ground's mean force F over an interval, N, from the rates (rad/s) around it and the torque (N m)."""
        return np.asarray((torque - (after - response.decay * before) / response.gain) / self.radius)
