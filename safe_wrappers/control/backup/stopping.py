"""Kinetic stopping insets in one dimension, for commands that are held between samples, and rows of controls.

Source: appendix "Relative degree and kinetic stopping insets" and its footnote 1. The barrier is the clearance left
after braking, `h = D - v^2 / (2 a_brake)` with approach speed v; state error, hold interval and delay are reserves
inside it. `a_brake` is a *validated lower bound* on the deceleration and is not checked here. Along the line to each
surface the motion is one-dimensional: the acceleration of the approach is bounded, which is affine in the control.
"""

import math
from typing import Final

import numpy as np

from safe_wrappers.control.compiled import compiled
from safe_wrappers.control.numerics.shapes import nearest_points
from safe_wrappers.errors import Array

_RETREAT_RATE: Final = 1.0
"""1/s: rate at which a violation is to shrink."""
_UNBOUNDED: Final = 1e12
"""A control without a bound counts as this large."""

Machine = tuple[Array, Array, float, float, float, float, float]
"""What is the same for all points.

* low, high: bounds of the control, shape (m,)
* delay_s: as for `approaches`
* control_dt: control interval, s
* radius: as for `approaches`
* braking: deceleration to count on, m/s^2
* reserve: kept free in the rows, m, but not in the rooms
"""


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
def approaches(
    distance: Array, normal: Array, surface_velocity: Array, velocity: Array, delay_s: float, radius: float
) -> tuple[Array, Array]:
    """Clearances, m, and approach speeds, m/s, of a point from k surfaces, shapes (k,).

    Args:
        distance: Of the point from the surfaces, m, shape (k,).
        normal: Unit vectors towards the point, shape (k, d).
        surface_velocity: m/s, shape (k, d).
        velocity: Of the point, m/s, shape (d,).
        delay_s: The point is predicted over it already. What comes to meet it is here, s (a lower bound: distance is
            convex).
        radius: Of the machine around the point, m.
    """
    clearance, speed = distance.copy(), np.zeros(len(distance))
    for i in range(len(distance)):
        met = closing = 0.0
        for j in range(len(velocity)):
            met += normal[i, j] * surface_velocity[i, j]
            closing += normal[i, j] * (velocity[j] - surface_velocity[i, j])
        clearance[i] = distance[i] - delay_s * met - radius
        speed[i] = -closing
    return clearance, speed


@compiled
def _away(
    normal: Array,
    surface_velocity: Array,
    curvature: Array,
    velocity: Array,
    acceleration: Array,
    speed: float,
    outside: bool,
) -> float:
    """Acceleration of the distance to a surface, m/s^2: along the normal, and of passing by on the outside."""
    bend = sharpest = along = 0.0
    for j in range(len(velocity)):
        sideways = velocity[j] - surface_velocity[j]
        bend += curvature[j] * (sideways * sideways)
        sharpest = max(sharpest, curvature[j])
        along += normal[j] * acceleration[j]
    bend -= sharpest * (speed * speed)
    return along + bend if outside and not bend <= 0.0 else along


@compiled
def _largest(low: float, high: float) -> float:
    """Of the controls between two bounds."""
    most = max(abs(low), abs(high))
    return most if most < math.inf else _UNBOUNDED


@compiled
def approach_rows(
    distance: Array,
    normal: Array,
    surface_velocity: Array,
    curvature: Array,
    velocity: Array,
    drift: Array,
    effect: Array,
    machine: Machine,
) -> tuple[Array, Array, Array]:
    """Rooms left after braking, and a row for every surface whose limit the actuators could exceed.

    Args:
        distance: As for `approaches`.
        normal: Likewise.
        surface_velocity: Likewise.
        curvature: Of the surfaces of equal distance along each coordinate, 1/m, shape (k, d).
        velocity: As for `approaches`.
        drift: The point's acceleration is `drift + effect @ u`, m/s^2, shape (d,).
        effect: Shape (d, m).
        machine: See `Machine`.

    Returns:
        Rooms, m, shape (k,); normals, shape (r, m), and offsets, shape (r,), of the rows.
    """
    low, high, delay_s, control_dt, radius, braking, reserve = machine
    clearance, speed = approaches(distance, normal, surface_velocity, velocity, delay_s, radius)
    room, rows, d, m = np.empty(len(distance)), 0, len(velocity), len(low)
    normals, offsets = np.zeros((len(distance), m)), np.empty(len(distance))
    for i in range(len(distance)):
        room[i] = clearance[i] - held_stop(speed[i], braking, control_dt)
        limit = held_limit(clearance[i] - reserve, speed[i], braking, control_dt)
        outside = clearance[i] + radius > 0.0
        limit += _away(normal[i], surface_velocity[i], curvature[i], velocity, drift, speed[i], outside)
        strongest = 0.0
        for k in range(m):
            push = 0.0
            for j in range(d):
                push -= normal[i, j] * effect[j, k]
            normals[rows, k] = push
            strongest += abs(push) * _largest(low[k], high[k])
        # Negated, so that a row that is not a number is kept, and fails, instead of being left out.
        if not strongest <= limit:
            offsets[rows] = limit
            rows += 1
    return room, normals[:rows].copy(), offsets[:rows].copy()


@compiled
def approach_rows_of(
    surfaces: Array, point: Array, velocity: Array, drift: Array, effect: Array, machine: Machine
) -> tuple[Array, Array, Array]:
    """`approach_rows` of surfaces that stand still, as in `control/numerics/shapes.py`, shape (k, 8)."""
    distance, normal, curvature = nearest_points(surfaces, point)
    still = np.zeros(normal.shape)
    return approach_rows(distance, normal, still, curvature, velocity, drift, effect, machine)
