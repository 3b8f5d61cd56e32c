"""Kinetic stopping insets in one dimension, for commands that are held between samples.

Source: appendix "Relative degree and kinetic stopping insets" and its footnote 1. The barrier is the clearance left
after braking, `h = D - v^2 / (2 a_brake)` with approach speed v; state error, hold interval and delay are reserves
inside it. `a_brake` is a *validated lower bound* on the deceleration and is not checked here.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array
from safe_wrappers.control.numerics.compiled import compiled

_RETREAT_RATE: Final = 1.0
"""1/s: rate at which a violation is to shrink."""


def predicted_approach(
    clearance: ArrayLike, speed: ArrayLike, delay_s: float, pending: ArrayLike
) -> tuple[Array, Array]:
    """Clearance (m) and approach speed (m/s), shape (...) each, after a delay with a constant approach acceleration.

    `pending` is the acceleration in the delay, m/s^2: of the commands in flight, or the largest possible one.
    """
    room, v, a = (np.asarray(x, dtype=np.float64) for x in (clearance, speed, pending))
    return np.asarray(room - v * delay_s - 0.5 * a * delay_s**2), np.asarray(v + a * delay_s)


@compiled
def held_stop(speed: float, brake: float, control_dt: float) -> float:
    """`held_stopping_distance` of one speed."""
    loss = brake * control_dt
    holds = (0.0 if speed <= 0.0 else speed) / loss
    whole = float(np.floor(holds))
    return loss * control_dt * (0.5 * (whole * whole) + (whole + 0.5) * (holds - whole))


@compiled
def held_limit(room: float, speed: float, brake: float, control_dt: float) -> float:
    """`sampled_acceleration_limit` for one room, m, all reserves taken off, and one speed."""
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


@compiled
def _stops(speeds: Array, brake: float, control_dt: float) -> Array:
    found = np.empty(len(speeds))
    for i in range(len(speeds)):
        found[i] = held_stop(speeds[i], brake, control_dt)
    return found


@compiled
def _limits(rooms: Array, speeds: Array, brake: float, control_dt: float) -> Array:
    found = np.empty(len(rooms))
    for i in range(len(rooms)):
        found[i] = held_limit(rooms[i], speeds[i], brake, control_dt)
    return found


def held_stopping_distance(speed: ArrayLike, brake: float, control_dt: float) -> Array:
    """The shortest stopping distance, m, if every deceleration (m/s^2) is held for a whole interval.

    The chord of `v^2 / (2 a_brake)` between whole multiples of the speed (m/s) that one hold removes.
    """
    speeds = np.asarray(speed, dtype=np.float64)
    return _stops(speeds.ravel(), float(brake), float(control_dt)).reshape(speeds.shape)


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
    rooms, speeds = np.broadcast_arrays(room0 - state_error - margin, v)
    found = _limits(rooms.flatten(), speeds.flatten(), float(brake), float(control_dt))
    return found.reshape(rooms.shape)


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
