"""What bounds the blends of the seam table, chosen from the machine and not from the outcome."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.flexible_joint import resonances, torque_slew_limit

RAMP_ENERGY = 1e-3
"""J that one ramp of torque at the rate limit may leave ringing in the arm, in any pose."""
PERIODS = 1.2
"""Of the lowest resonance, that a blend takes at the least: over so long a smoothstep from one held torque to another
leaves at most a tenth of the energy that the step itself would (`flexible_joint.smoothstep_energy`)."""


@dataclass(frozen=True)
class Bounds:
    """Of the blends on one env.

    Attributes:
        rate_limit: One for each control, action units per second.
        blend_time: s.
        reasons: How they were chosen, for the table.
    """

    rate_limit: list[float]
    blend_time: float
    reasons: str


def bounds_of(env: Any, horizon: int, range_per_second: float) -> Bounds:
    """From the arm's resonances, or, where there are none, from the action's range and the time between seams.

    Args:
        env: Any of gymnasium's; `FlexJointReach-v0` has an arm.
        horizon: Control steps from one seam to the next.
        range_per_second: Where no arm says more: how often per second the rate goes through the action's range.
    """
    hold, high = env.get_wrapper_attr("dt"), env.action_space.high
    arm = getattr(env.unwrapped, "arm", None)
    if arm is None:
        rate = float(range_per_second * (env.action_space.high - env.action_space.low).min())
        span = horizon * hold
        reasons = (
            f"rate {rate:g} action units/s, {range_per_second:g} action ranges per second; time {span:.3g} s, the "
            "time between two seams, so that a blend ends when the next begins"
        )
        return Bounds([rate] * len(high), span, reasons)
    angles = np.zeros((721, 2))
    angles[:, 1] = np.linspace(-math.pi, math.pi, len(angles))
    constants = arm.stiffness, arm.rotor_inertia, arm.link_inertia(angles)
    limit = torque_slew_limit(RAMP_ENERGY, *constants, weights=high, control_dt=hold).min(axis=0)
    lowest = float(resonances(*constants).min()) / (2.0 * math.pi)
    span = PERIODS / lowest
    reasons = (
        f"rate {limit[0]:.2f} and {limit[1]:.2f} N m/s, with which a single ramp of torque leaves at most "
        f"{1e3 * RAMP_ENERGY:g} mJ ringing in any pose; time {span:.3f} s, {PERIODS} periods of the lowest resonance "
        f"({lowest:.1f} Hz), over which a smoothstep leaves at most a tenth of the energy that the step itself would"
    )
    return Bounds(limit.tolist(), span, reasons)
