"""Kinetic stopping insets in one dimension, for commands that are held between samples.

Source: appendix "Relative degree and kinetic stopping insets" and its footnote 1. The barrier is the clearance left
after braking, `h = D - v^2 / (2 a_brake)` with approach speed v; state error, hold interval and delay are reserves
inside it. `a_brake` is a *validated lower bound* on the deceleration and is not checked here.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_RETREAT_RATE = 1.0
"""1/s: rate at which a violation is to shrink."""


def predicted_approach(
    clearance: ArrayLike, speed: ArrayLike, delay_s: float, pending: ArrayLike
) -> tuple[Array, Array]:
    """Clearance (m) and approach speed (m/s), shape (...) each, after a delay with a constant approach acceleration.

    `pending` is the acceleration in the delay, m/s^2: of the commands in flight, or the largest possible one.
    """
    room, v, a = (np.asarray(x, dtype=np.float64) for x in (clearance, speed, pending))
    return np.asarray(room - v * delay_s - 0.5 * a * delay_s**2), np.asarray(v + a * delay_s)


def held_stopping_distance(speed: ArrayLike, brake: float, control_dt: float) -> Array:
    """The shortest stopping distance, m, if every deceleration (m/s^2) is held for a whole interval.

    The chord of `v^2 / (2 a_brake)` between whole multiples of the speed (m/s) that one hold removes.
    """
    loss = brake * control_dt
    holds = np.maximum(np.asarray(speed, dtype=np.float64), 0.0) / loss
    whole = np.floor(holds)
    return np.asarray(loss * control_dt * (0.5 * whole**2 + (whole + 0.5) * (holds - whole)))


def sampled_acceleration_limit(
    clearance: ArrayLike,
    speed: ArrayLike,
    brake: float,
    control_dt: float,
    *,
    delay_s: float = 0.0,
    pending: ArrayLike = 0.0,
    state_error: float = 0.0,
    margin: float = 0.0,
) -> Array:
    """The largest approach acceleration, m/s^2, shape (...), that may be *held* for a whole control interval.

    Over the delay the commands in flight act, over the hold the new one; from there on held braking must stop the
    machine inside the room (clearance less reserves). It is at least `-brake` wherever `sampled_inset` is not
    negative. From outside it is the braking that halts inside the remaining room or, without room, a retreat.

    Args:
        clearance: Measured clearance D in m, shape (...).
        speed: Measured approach speed in m/s, shape (...).
        brake: Validated braking deceleration in m/s^2.
        control_dt: Control interval in s.
        delay_s: Evidence age plus detection plus actuation delay, in s.
        pending: Approach acceleration of the commands in flight during the delay, m/s^2, shape (...).
        state_error: Bound on the error of the measured clearance, in m.
        margin: Fixed protective distance, in m.
    """
    room0, v = predicted_approach(clearance, speed, delay_s, pending)
    room = room0 - state_error - margin
    # In units of the speed and the distance of one hold of full braking the condition on the end speed w is
    # w / 2 + (chord of w^2 / 2) <= left, which at whole w = k reads k (k + 1) / 2 and has slope k + 1 above it.
    left = (room - 0.5 * v * control_dt) / (brake * control_dt**2)
    whole = np.floor(0.5 * (np.sqrt(1.0 + 8.0 * np.maximum(left, 0.0)) - 1.0))
    end = (whole + (left - 0.5 * whole * (whole + 1.0)) / (whole + 1.0)) * brake * control_dt
    # Otherwise the motion must reverse inside the hold, before the room ends if there is some.
    approach = np.maximum(v, 0.0)
    with np.errstate(divide="ignore", over="ignore"):
        halting = -(approach**2) / (2.0 * np.where(room > 0.0, room, np.inf))
    retreat = (_RETREAT_RATE * np.minimum(room, 0.0) - v) / control_dt
    late = np.where(room > 0.0, np.minimum(halting, -v / control_dt), retreat)
    return np.asarray(np.where(left >= 0.0, (end - v) / control_dt, late))


def sampled_inset(
    clearance: ArrayLike,
    speed: ArrayLike,
    brake: float,
    control_dt: float,
    *,
    delay_s: float = 0.0,
    pending: ArrayLike = 0.0,
    state_error: float = 0.0,
    margin: float = 0.0,
) -> Array:
    """The barrier that `sampled_acceleration_limit` keeps non-negative: room left after delay and held braking, m.

    Full braking is admissible at every sample where it is not negative, and never makes it smaller.
    """
    room, v = predicted_approach(clearance, speed, delay_s, pending)
    return np.asarray(room - state_error - margin - held_stopping_distance(v, brake, control_dt))
