"""A driven wheel over one control interval: its rate under drive torque and traction force.

`I w' = tau - k w - b w - r F`, with torque and force constant over the interval and k the feedback of a speed servo,
stepped with implicit damping as MuJoCo's Euler integrators do: `w+ = decay w + gain (tau - r F)`, exactly. Solved for
F it is a traction-force observer; other torques on the axle (dry friction, a spring) appear in F.

Source: appendix "Wheel slip ratio and friction boundaries" (the wheel's equation).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError


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

    def __post_init__(self) -> None:
        for name, least in (("radius", "> 0 m"), ("inertia", "> 0 kg m^2"), ("damping", ">= 0 N m s/rad")):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            fits = value >= 0.0 if least.startswith(">=") else value > 0.0
            if not (np.isfinite(value).all() and fits.all()):
                raise ConfigurationError(f"a wheel's {name} must be finite and {least}, got {value}")
            object.__setattr__(self, name, value)

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
