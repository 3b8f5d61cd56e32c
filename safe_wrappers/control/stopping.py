"""Kinetic stopping insets in one dimension, continuous and sampled.

Source: appendix "Relative degree and kinetic stopping insets" and its footnote 1. A clearance D has relative
degree two under an acceleration command, so the barrier is the clearance left after braking,
`h = D - v^2 / (2 a_brake)` with approach speed v. The appendix's caveat is a requirement here: state error,
hold interval and delay are reserves inside the barrier, so that what is promised holds between samples too.

`a_brake` is a *validated lower bound* on the deceleration that the actuators can give in every state of the
declared envelope. Nothing here can check that; the constraint that uses it says where its bound comes from.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def kinetic_inset(clearance: ArrayLike, speed: ArrayLike, brake: float) -> Array:
    """`h = D - v^2 / (2 a_brake)`; receding (v <= 0) needs no stopping distance.

    Args:
        clearance: Distance to the obstacle D in m (or rad), shape (...).
        speed: Approach speed v in m/s, positive towards the obstacle, shape (...).
        brake: a_brake in m/s^2, positive.
    """
    approach = np.maximum(np.asarray(speed, dtype=np.float64), 0.0)
    return np.asarray(np.asarray(clearance, dtype=np.float64) - approach**2 / (2.0 * brake))


def kinetic_row(clearance: ArrayLike, speed: ArrayLike, brake: float, gamma: float) -> Array:
    """The continuous row: the largest admissible approach acceleration, `(a_brake / v)(gamma h - v)`.

    Only for v > 0. At standstill the row is singular and says nothing: there it returns +inf where the
    inset is positive and 0 where it is not (the start rule of the continuous form: do not set off).
    """
    v = np.asarray(speed, dtype=np.float64)
    h = kinetic_inset(clearance, speed, brake)
    moving = v > 0.0
    safe_v = np.where(moving, v, 1.0)
    return np.asarray(np.where(moving, brake / safe_v * (gamma * h - safe_v), np.where(h > 0.0, np.inf, 0.0)))


def predicted_approach(
    clearance: ArrayLike, speed: ArrayLike, delay_s: float, pending: ArrayLike
) -> tuple[Array, Array]:
    """Clearance and approach speed after the delay, while already sent commands give `pending` (m/s^2).

    Use the commands in flight where they are known, else the worst acceleration that they may be.
    """
    v = np.asarray(speed, dtype=np.float64)
    a = np.asarray(pending, dtype=np.float64)
    return (
        np.asarray(clearance, dtype=np.float64) - v * delay_s - 0.5 * a * delay_s**2,
        np.asarray(v + a * delay_s),
    )


def largest_speed(room: ArrayLike, brake: float) -> Array:
    """The approach speed from which braking stops within `room` (m), shape (...)."""
    return np.sqrt(2.0 * brake * np.maximum(np.asarray(room, dtype=np.float64), 0.0))


def sampled_acceleration_limit(
    clearance: ArrayLike,
    speed: ArrayLike,
    brake: float,
    hold_s: float,
    *,
    delay_s: float = 0.0,
    pending: ArrayLike = 0.0,
    state_error: float = 0.0,
    margin: float = 0.0,
) -> Array:
    """The largest approach acceleration that may be *held* for a whole control interval.

    Over the delay the commands in flight act, over the hold the new one, and from there on braking must still
    stop the machine inside the room: `x(hold) + v(hold)^2 / (2 a_brake) <= room`. Solved exactly for the
    speed at the end of the hold, so no sampling reserve is wasted, and valid at standstill: this is also the
    start rule. Where the machine must come to rest within the hold, the limit is the braking that does it.

    Args:
        clearance: Measured clearance D in m, shape (...).
        speed: Measured approach speed in m/s, shape (...).
        brake: Validated braking deceleration in m/s^2.
        hold_s: Control interval in s.
        delay_s: Evidence age plus detection plus actuation delay, in s.
        pending: Approach acceleration of the commands in flight during the delay, m/s^2, shape (...).
        state_error: Bound on the error of the measured clearance, in m.
        margin: Fixed protective distance, in m.

    Returns:
        Limit in m/s^2, shape (...). Below `-brake` the state is outside the set that this barrier keeps: no
        admissible command stops in time. `-inf` once the room is gone while still approaching.
    """
    room0, v = predicted_approach(clearance, speed, delay_s, pending)
    room = room0 - state_error - margin
    half = 0.5 * brake * hold_s
    under_root = 2.0 * brake * (room - 0.5 * v * hold_s)
    v_end = -half + np.sqrt(np.maximum(half * half + under_root, 0.0))
    carried = (v_end - v) / hold_s
    approach = np.maximum(v, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        halted = np.where(
            room > 0.0,
            -(approach**2) / (2.0 * np.where(room > 0.0, room, 1.0)),
            np.where(approach > 0.0, -np.inf, 0.0),
        )
    # v_end >= 0: still moving (or at rest) at the end of the hold; below, it must halt inside the hold.
    moves_on = (half * half + under_root >= 0.0) & (v_end >= 0.0)
    receding = v <= 0.0
    # Receding with the room gone: any acceleration must not turn it round within the hold.
    turned = np.where(receding & (room <= 0.0), -v / hold_s, halted)
    return np.asarray(np.where(moves_on, carried, turned))


def sampled_inset(
    clearance: ArrayLike,
    speed: ArrayLike,
    brake: float,
    *,
    delay_s: float = 0.0,
    pending: ArrayLike = 0.0,
    state_error: float = 0.0,
    margin: float = 0.0,
) -> Array:
    """The barrier that `sampled_acceleration_limit` keeps non-negative: room left after delay and braking.

    It needs no hold term: braking is admissible at every sample, and a hold that is admitted ends with a
    non-negative inset by construction. Unsafe is negative; units of the clearance.
    """
    room, v = predicted_approach(clearance, speed, delay_s, pending)
    return kinetic_inset(room - state_error - margin, v, brake)
