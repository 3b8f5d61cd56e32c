"""Kinetic stopping insets in one dimension, for commands that are held between samples, and rows of controls.

Source: appendix "Relative degree and kinetic stopping insets" and its footnote 1. The barrier is the clearance left
after braking, `h = D - v^2 / (2 a_brake)` with approach speed v; state error, hold interval and delay are reserves
inside it. `a_brake` is a *validated lower bound* on the deceleration and is not checked here. Along the line to each
surface the motion is one-dimensional: the acceleration of the approach is bounded, which is affine in the control.

The functions are compiled.
"""

import math
from typing import Final, NamedTuple

import numpy as np

from safe_wrappers.control.compiled import compiled
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


@compiled
def approaches(near: Nearest, velocity: Array, delay_s: float, radius: float) -> tuple[Array, Array]:
    """Clearances, m, and approach speeds, m/s, of a point from k surfaces, shapes (k,).

    Args:
        near: The surfaces.
        velocity: Of the point, m/s, shape (d,).
        delay_s: The point is predicted over it already. What comes to meet it is here, s (a lower bound: distance is
            convex).
        radius: Of the machine around the point, m.
    """
    met = (near.normal * near.velocity).sum(axis=1)
    return near.distance - delay_s * met - radius, met - (near.normal * velocity).sum(axis=1)


class Machine(NamedTuple):
    """What is the same for all points."""

    low: Array  # smallest control, shape (m,)
    high: Array  # largest control, shape (m,)
    delay_s: float  # as for `approaches`
    control_dt: float  # control interval, s
    radius: float  # as for `approaches`
    braking: float  # deceleration to count on, m/s^2
    reserve: float  # kept free in the rows, m, but not in the rooms


@compiled
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
    m = machine
    clearance, speed = approaches(near, velocity, m.delay_s, m.radius)
    most = np.minimum(np.maximum(np.abs(m.low), np.abs(m.high)), _UNBOUNDED)
    normals, offsets, rows = np.empty((len(speed), len(most))), np.empty(len(speed)), 0
    room = np.empty(len(speed))
    for i in range(len(speed)):
        room[i] = clearance[i] - held_stop(speed[i], m.braking, m.control_dt)
        normal, curvature, sideways = near.normal[i], near.curvature[i], velocity - near.velocity[i]
        limit = held_limit(clearance[i] - m.reserve, speed[i], m.braking, m.control_dt)
        limit += (normal * drift).sum()
        # Who passes by on the outside of a round surface moves away from it.
        bend = (curvature * sideways * sideways).sum() - curvature.max() * speed[i] * speed[i]
        if clearance[i] + m.radius > 0.0 and not bend <= 0.0:
            limit += bend
        for k in range(len(most)):
            normals[rows, k] = -(normal * effect[:, k]).sum()
        # Negated, so that a row that is not a number is kept, and fails, instead of being left out.
        if not (np.abs(normals[rows]) * most).sum() <= limit:
            offsets[rows] = limit
            rows += 1
    return room, normals[:rows].copy(), offsets[:rows].copy()
