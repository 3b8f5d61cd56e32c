"""One axis of a damped point mass under a held force: exact step, stopping distance and its inverse.

A physics step maps speed v and control u to `v' = decay v + gain u` and moves by `timestep v'` (MuJoCo's
semi-implicit Euler step with implicit joint damping). A control is held for `substeps` of them, so a hold is linear:
`v_end = A v + B u`, `x_end = x + P v + Q u`. Braking is the full opposing control, and in the last hold `-A v / B`,
which ends at rest. The stopping distance is piecewise linear in v: a knot at each speed that n full holds remove.
"""

import math
from typing import Final, NamedTuple

import numpy as np

from safe_wrappers.control.compiled import compiled
from safe_wrappers.errors import Array

_MOST_HOLDS: Final = 4096
"""Length of the table, in holds of full braking; the distance beyond it is infinite."""
_FLAT: Final = 1e9
"""m/s; end of the constant part of the table above the clip."""


class DampedAxis(NamedTuple):
    """Constants of one axis, made by `damped_axis`.

    Attributes:
        decay: Share of the speed that one physics step keeps without control, in (0, 1].
        gain: Speed that one physics step adds per control, m/s, > 0.
        timestep: Physics step, s.
        substeps: Physics steps per control step.
        low: Smallest control, < 0.
        high: Largest control, > 0.
        clip: Speed to which the env clips the motion at the start of every control step, m/s; inf for none.
        keep: A: share of the speed that one hold keeps.
        add: B: speed that one hold adds per control, m/s.
        drift: P: displacement in one hold per speed, s.
        shift: Q: displacement in one hold per control, m.
        up: Stopping from speeds >= 0, shape (3, k): the knots, m/s, ascending from 0; the distances, m; the distances
            with the part of the hold before that is proportional to the speed, m.
        down: Likewise, from speeds <= 0.
    """

    decay: float
    gain: float
    timestep: float
    substeps: int
    low: float
    high: float
    clip: float
    keep: float
    add: float
    drift: float
    shift: float
    up: Array
    down: Array


def damped_axis(
    decay: float,
    gain: float,
    timestep: float,
    substeps: int,
    low: float,
    high: float,
    clip: float = math.inf,
) -> DampedAxis:
    """The axis of these constants, with its tables."""
    keep, add, drift, shift = 1.0, 0.0, 0.0, 0.0
    for _ in range(substeps):
        keep, add = decay * keep, decay * add + gain
        drift, shift = drift + timestep * keep, shift + timestep * add
    none = np.zeros((3, 0))
    axis = DampedAxis(
        decay, gain, timestep, substeps, low, high, clip, keep, add, drift, shift, up=none, down=none
    )
    along = float(keep), float(add), float(drift), float(shift)
    return axis._replace(up=_table(*along, -low, clip), down=_table(*along, high, clip))


@compiled
def _interpolate(xs: Array, ys: Array, x: float) -> float:
    """Between knots, from the first on; infinite beyond the last."""
    first, i = 0, len(xs)
    while first < i:
        middle = (first + i) // 2
        if x < xs[middle]:
            i = middle
        else:
            first = middle + 1
    if i == len(xs):
        return float(ys[-1]) if x == xs[-1] else math.inf
    before = xs[i - 1]
    return float(ys[i - 1] + (x - before) / (xs[i] - before) * (ys[i] - ys[i - 1]))


@compiled
def _table(keep: float, add: float, drift: float, shift: float, brake: float, clip: float) -> Array:
    """The table for one direction of motion, up to the clip or to `_MOST_HOLDS` knots."""
    loss, lost_way, per_speed = add * brake, shift * brake, shift / add
    # Displacement of the last hold, per speed.
    just_stops = drift - shift * keep / add
    table = np.zeros((3, _MOST_HOLDS + 1))
    speed, way, k = loss / keep, just_stops * loss / keep, 1
    table[0, 1], table[1, 1], table[2, 1] = speed, way, per_speed * speed + way
    while k < _MOST_HOLDS - 1 and speed < clip:
        k += 1
        speed = (speed + loss) / keep
        way = drift * speed - lost_way + way
        table[0, k], table[1, k], table[2, k] = speed, way, per_speed * speed + way
    if speed >= clip:
        way = _interpolate(table[0, : k + 1], table[1, : k + 1], clip)
        table[0, k], table[1, k], table[2, k] = clip, way, per_speed * clip + way
        k += 1
        table[0, k], table[1, k], table[2, k] = _FLAT, way, per_speed * _FLAT + way
    return table[:, : k + 1].copy()


@compiled
def _speed(table: Array, total: float) -> float:
    """The inverse of the totals; the largest tabulated speed beyond them."""
    return table[0, -1] if total >= table[2, -1] else _interpolate(table[2], table[0], total)


@compiled
def clipped(axis: DampedAxis, v: float) -> float:
    """The speed after the env's clip."""
    return max(-axis.clip, min(v, axis.clip))


@compiled
def step(axis: DampedAxis, x: float, v: float, u: float) -> tuple[float, float]:
    """Position and speed at the end of a hold; `v` is already clipped."""
    u = max(axis.low, min(u, axis.high))
    return x + axis.drift * v + axis.shift * u, axis.keep * v + axis.add * u


@compiled
def rest(axis: DampedAxis, x: float, v: float) -> float:
    """Position at which braking comes to rest."""
    if v >= 0.0:
        return x + _interpolate(axis.up[0], axis.up[1], v)
    return x - _interpolate(axis.down[0], axis.down[1], -v)


@compiled
def brake(axis: DampedAxis, v: float) -> float:
    """The control that brakes fully, or just to rest within one hold."""
    return max(axis.low, min(-axis.keep * clipped(axis, v) / axis.add, axis.high))


@compiled
def braking(axis: DampedAxis, x: float, v: float) -> Array:
    """Positions at the ends of the holds of the braking manoeuvre, the present one first, rest last."""
    v = clipped(axis, v)
    end, control = rest(axis, x, v), axis.low if v >= 0.0 else axis.high
    shift, loss = axis.shift * control, axis.add * control
    last, direction = abs(loss) / axis.keep, 1.0 if v >= 0.0 else -1.0
    points, count = np.empty(_MOST_HOLDS + 2), 1
    points[0] = x
    while direction * v > last and count <= _MOST_HOLDS:
        x, v = x + axis.drift * v + shift, axis.keep * v + loss
        points[count] = x
        count += 1
    if x != end:
        points[count] = end
        count += 1
    return points[:count]


@compiled
def extent(axis: DampedAxis, x: float, v: float, u: float) -> tuple[float, float]:
    """Least and greatest position during a hold, its start included; `v` is already clipped."""
    end, speed = step(axis, x, v, u)
    if axis.substeps == 1 or v * speed >= 0.0:
        return min(x, end), max(x, end)
    u = max(axis.low, min(u, axis.high))
    least = most = x
    for _ in range(axis.substeps):
        v = axis.decay * v + axis.gain * u
        x += axis.timestep * v
        least, most = min(least, x), max(most, x)
    return least, most


@compiled
def control_to_rest_at(axis: DampedAxis, x: float, v: float, target: float) -> float:
    """The control whose hold, and braking after it, comes to rest at `target`; it may be out of bounds.

    The rest point grows with the control. `v` is already clipped.
    """
    per_speed = axis.shift / axis.add
    way = target - x - (axis.drift - per_speed * axis.keep) * v
    end = _speed(axis.up, way) if way >= 0.0 else -_speed(axis.down, -way)
    return (end - axis.keep * v) / axis.add
