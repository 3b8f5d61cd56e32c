"""A point mass among walls for plain Python: what lasts from step to step in arrays, and one call per question."""

import math

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.control.backup.damped_axis import DampedAxis
from safe_wrappers.control.backup.point_among_walls import (
    Pair,
    PointAmongWalls,
    PointMotion,
    clipped,
    distance,
)
from safe_wrappers.control.backup.point_decision import admits, backup, bounds, near
from safe_wrappers.control.numerics.compiled import compiled
from safe_wrappers.control.numerics.planar import Rectangle

PROPOSAL, CANDIDATE, UNRESOLVED = 0, 2, 7
"""What `closest_admitted` returns: a `Stage` of the search, or that it has found no admitted control."""


Scene = tuple[Array, Array, Array, Array, Array, Array]
"""What the functions below take first, as a plain tuple, which compiled code takes fastest.

* numbers: along x and along y, shape (2, 16): the numbers of the axis; where the point is at qpos = 0, m; the
  indices of its slide in qpos and qvel, and of its actuator; the distance to keep, m; `clip_known`
* the tables of the axes: x up, x down, y up, y down
* walls: rectangles, m, shape (n, 4)
"""


def scene(
    axes: tuple[DampedAxis, DampedAxis],
    origin: Pair,
    joints: tuple[int, int],
    actuators: tuple[int, int],
    room: float,
    clip_known: bool,
    among: list[Rectangle],
) -> Scene:
    """The scene of a point; of pairs x is first, then y."""
    rows = [
        [*axis[:-2], *of_axis, room, clip_known]
        for axis, *of_axis in zip(axes, origin, joints, actuators, strict=True)
    ]
    x_axis, y_axis = axes
    tables = x_axis.up, x_axis.down, y_axis.up, y_axis.down
    return np.array(rows, dtype=np.float64), *tables, np.array(among, dtype=np.float64).reshape(-1, 4)


@compiled
def _axis(numbers: Array, up: Array, down: Array) -> DampedAxis:
    n = numbers
    return DampedAxis(n[0], n[1], n[2], int(n[3]), n[4], n[5], n[6], n[7], n[8], n[9], n[10], up, down)


@compiled
def _in(scene: Scene) -> PointAmongWalls:
    numbers, x_up, x_down, y_up, y_down, walls = scene
    x_axis, y_axis = _axis(numbers[0], x_up, x_down), _axis(numbers[1], y_up, y_down)
    return PointAmongWalls(x_axis, y_axis, walls, numbers[0, 15] != 0.0)


@compiled
def _moving(motion: Array) -> PointMotion:
    return PointMotion(motion[0], motion[1], motion[2], motion[3])


@compiled
def _pair(numbers: Array, control: Array) -> Pair:
    return control[int(numbers[0, 13])], control[int(numbers[1, 13])]


@compiled
def room_left(scene: Scene, qpos: Array, qvel: Array, motion: Array) -> float:
    """What braking leaves beyond the room, m; NaN if the state is not finite. Writes the clipped motion, (4,)."""
    among, numbers = _in(scene), scene[0]
    for axis in range(2):
        motion[axis] = qpos[int(numbers[axis, 12])] + numbers[axis, 11]
        motion[2 + axis] = qvel[int(numbers[axis, 12])]
    now = clipped(among, _moving(motion))
    finite = math.isfinite(motion[0] + motion[1] + motion[2] + motion[3])
    motion[2], motion[3] = now.vx, now.vy
    return distance(among, now) - numbers[0, 14] if finite else math.nan


@compiled
def is_admitted(scene: Scene, motion: Array, left: float, control: Array) -> bool:
    """Whether a control, shape (m,), keeps the room, or from outside shrinks the violation."""
    among, numbers = _in(scene), scene[0]
    return admits(among, _moving(motion), numbers[0, 14], left, _pair(numbers, control), 0.0)


@compiled
def closest_admitted(
    scene: Scene, motion: Array, left: float, low: Array, high: Array, control: Array
) -> int:
    """Replaces a control, shape (m,), by the closest candidate in the box that is admitted; the stage that did it."""
    among, numbers = _in(scene), scene[0]
    now, room, asked = _moving(motion), numbers[0, 14], _pair(numbers, control)
    if admits(among, now, room, left, asked, 0.0):
        return PROPOSAL
    i, j = int(numbers[0, 13]), int(numbers[1, 13])
    found = near(among, now, room, left, asked)
    for k in range(len(found)):
        x, y = min(max(found[k, 0], low[i]), high[i]), min(max(found[k, 1], low[j]), high[j])
        if math.isfinite(x + y) and admits(among, now, room, left, (x, y), 0.0):
            control[i], control[j] = x, y
            return CANDIDATE
    return UNRESOLVED


@compiled
def candidates(scene: Scene, motion: Array, left: float, control: Array) -> Array:
    """Admissible pairs near a refused control, the nearest first, shape (k, 2)."""
    among, numbers = _in(scene), scene[0]
    return near(among, _moving(motion), numbers[0, 14], left, _pair(numbers, control))


@compiled
def backup_pair(scene: Scene, motion: Array, left: float) -> Pair:
    """The pair that is always admitted: brake both axes. From outside it leads back inside."""
    among, numbers = _in(scene), scene[0]
    return backup(among, _moving(motion), numbers[0, 14], left)


@compiled
def half_spaces(scene: Scene, motion: Array, left: float) -> tuple[Array, Array]:
    """Bounds on the pair: a convex part of what is admitted, shapes (k, 2) and (k,)."""
    among, numbers = _in(scene), scene[0]
    return bounds(among, _moving(motion), numbers[0, 14], left)
