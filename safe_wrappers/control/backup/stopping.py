"""Kinetic stopping insets in one dimension, for commands that are held between samples.

Source: appendix "Relative degree and kinetic stopping insets" and its footnote 1. The barrier is the clearance left
after braking, `h = D - v^2 / (2 a_brake)` with approach speed v; state error, hold interval and delay are reserves
inside it. `a_brake` is a *validated lower bound* on the deceleration and is not checked here.
"""

import math
from typing import Final

import numpy as np

from safe_wrappers.control.numerics.compiled import compiled

_RETREAT_RATE: Final = 1.0
"""1/s: rate at which a violation is to shrink."""


@compiled
def held_stop(speed: float, brake: float, control_dt: float) -> float:
    """The shortest stopping distance, m, if every deceleration is held for a whole control interval.

    The chord of `v^2 / (2 a_brake)` between whole multiples of the speed (m/s) that one hold removes.
    """
    loss = brake * control_dt
    holds = (0.0 if speed <= 0.0 else speed) / loss
    whole = float(np.floor(holds))
    return loss * control_dt * (0.5 * (whole * whole) + (whole + 0.5) * (holds - whole))


@compiled
def held_limit(room: float, speed: float, brake: float, control_dt: float) -> float:
    """The largest approach acceleration, m/s^2, that may be *held* for a whole control interval.

    After it held braking must stop the machine inside the room. It is at least `-brake` wherever the room is not less
    than `held_stop`. From outside it is the braking that halts inside the remaining room or, without room, a retreat.

    Args:
        room: Clearance less all reserves, m.
        speed: Approach speed, m/s.
        brake: Validated braking deceleration, m/s^2.
        control_dt: Control interval, s.
    """
    # In units of the speed and the distance of one hold of full braking the condition on the end speed w is
    # w / 2 + (chord of w^2 / 2) <= left, which at whole w = k reads k (k + 1) / 2 and has slope k + 1 above it.
    left = (room - 0.5 * speed * control_dt) / (brake * (control_dt * control_dt))
    if left >= 0.0:
        whole = float(np.floor(0.5 * (math.sqrt(1.0 + 8.0 * left) - 1.0)))
        end = (whole + (left - 0.5 * whole * (whole + 1.0)) / (whole + 1.0)) * brake * control_dt
        return (end - speed) / control_dt
    # Otherwise the motion must reverse inside the hold, before the room ends if there is some.
    if room > 0.0:
        approach = 0.0 if speed <= 0.0 else speed
        return min(-(approach * approach) / (2.0 * room), -speed / control_dt)
    return (_RETREAT_RATE * room - speed) / control_dt
