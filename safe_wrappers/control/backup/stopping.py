"""Kinetic stopping insets in one dimension, for commands that are held between samples, and rows of controls.

Source: appendix "Relative degree and kinetic stopping insets" and its footnote 1. The barrier is the clearance left
after braking, `h = D - v^2 / (2 a_brake)` with approach speed v; state error, hold interval and delay are reserves
inside it. `a_brake` is a *validated lower bound* on the deceleration and is not checked here. Along the line to each
surface the motion is one-dimensional: the acceleration of the approach is bounded, which is affine in the control.

Speeds, rooms and limits are arrays of one shape, or numbers.
"""

from typing import Final, NamedTuple

import numpy as np

from safe_wrappers.errors import Array

_RETREAT_RATE: Final = 1.0
"""1/s: rate at which a violation is to shrink."""
_UNBOUNDED: Final = 1e12
"""A control without a bound counts as this large."""


class Nearest(NamedTuple):
    """For one point and k surfaces in d dimensions."""

    distance: Array  # signed, m, negative inside, shape (k,)
    normal: Array  # unit vectors from the surface towards the point, shape (k, d)
    velocity: Array  # of the surface, m/s, shape (k, d)
    curvature: Array  # of the surface of equal distance through the point, along each coordinate, 1/m, (k, d)


def held_stop(speed: Array | float, brake: float, control_dt: float) -> Array:
    """The shortest stopping distance, m, if every deceleration is held for a whole control interval.

    The chord of `v^2 / (2 a_brake)` between whole multiples of the speed (m/s) that one hold removes.
    """
    loss = brake * control_dt
    holds = np.maximum(speed, 0.0) / loss
    whole = np.floor(holds)
    return np.asarray(loss * control_dt * (0.5 * whole**2 + (whole + 0.5) * (holds - whole)))


def held_limit(room: Array | float, speed: Array | float, brake: float, control_dt: float) -> Array:
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
    left = (room - 0.5 * speed * control_dt) / (brake * control_dt**2)
    whole = np.floor(0.5 * (np.sqrt(1.0 + 8.0 * np.maximum(left, 0.0)) - 1.0))
    end = (whole + (left - 0.5 * whole * (whole + 1.0)) / (whole + 1.0)) * brake * control_dt
    # Otherwise the motion must reverse inside the hold, before the room ends if there is some.
    halt = -(np.maximum(speed, 0.0) ** 2) / (2.0 * np.where(room > 0.0, room, 1.0))
    reversed_ = np.where(
        room > 0.0, np.minimum(halt, -speed / control_dt), (_RETREAT_RATE * room - speed) / control_dt
    )
    return np.asarray(np.where(left >= 0.0, (end - speed) / control_dt, reversed_))


def approaches(near: Nearest, velocity: Array, delay_s: float, radius: float) -> tuple[Array, Array]:
    """Clearances, m, and approach speeds, m/s, of a point from k surfaces, shapes (k,).

    Args:
        near: The surfaces.
        velocity: Of the point, m/s, shape (d,).
        delay_s: The point is predicted over it already. What comes to meet it is here, s (a lower bound: distance is
            convex).
        radius: Of the machine around the point, m.
    """
    met = np.einsum("kd,kd->k", near.normal, near.velocity)
    return near.distance - delay_s * met - radius, met - near.normal @ velocity


class Machine(NamedTuple):
    """What is the same for all points."""

    low: Array  # smallest control, shape (m,)
    high: Array  # largest control, shape (m,)
    delay_s: float  # as for `approaches`
    control_dt: float  # control interval, s
    radius: float  # as for `approaches`
    braking: float  # deceleration to count on, m/s^2
    reserve: float  # kept free in the rows, m, but not in the rooms


def approach_rows(
    near: Nearest, velocity: Array, drift: Array, effect: Array, machine: Machine
) -> tuple[Array, Array, Array]:
    """Rooms left after braking, and a row for every surface whose limit the actuators could exceed.

    Args:
        near: The surfaces.
        velocity: As for `approaches`.
        drift: The point's acceleration is `drift + effect @ u`, m/s^2, shape (d,).
        effect: Shape (d, m).
        machine: The rest.

    Returns:
        Rooms, m, shape (k,); normals, shape (r, m), and offsets, shape (r,), of the rows.
    """
    low, high, delay_s, control_dt, radius, braking, reserve = machine
    clearance, speed = approaches(near, velocity, delay_s, radius)
    limit = held_limit(clearance - reserve, speed, braking, control_dt) + near.normal @ drift
    # Who passes by on the outside of a round surface moves away from it.
    sharpest, sideways = near.curvature.max(axis=1), velocity - near.velocity
    bend = (near.curvature * sideways**2).sum(axis=1) - sharpest * speed**2
    limit += np.where((clearance + radius > 0.0) & ~(bend <= 0.0), bend, 0.0)
    pushes = -near.normal @ effect
    strongest = np.abs(pushes) @ np.minimum(np.maximum(np.abs(low), np.abs(high)), _UNBOUNDED)
    # Negated, so that a row that is not a number is kept, and fails, instead of being left out.
    close = ~(strongest <= limit)
    return clearance - held_stop(speed, braking, control_dt), pushes[close], limit[close]
