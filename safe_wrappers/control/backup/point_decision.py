"""Which controls leave a point mass among walls its way to rest, and the closest one to a refused one.

From outside the safe set (`left` below zero) the violation has to shrink. The functions for plain Python are at the
end: what lasts from step to step is in arrays, and there is one call per question.
"""

import math
from typing import Final, NamedTuple

import numpy as np

from safe_wrappers.control.backup import damped_axis as along
from safe_wrappers.control.backup.damped_axis import DampedAxis
from safe_wrappers.control.backup.point_among_walls import (
    Pair,
    PointAmongWalls,
    PointMotion,
    brake,
    clear,
    clipped,
    distance,
    reachable,
    reached,
    step,
    stop,
)
from safe_wrappers.control.compiled import compiled, hypot
from safe_wrappers.control.numerics.shapes import Rectangle, closer, gaps, nearest, one_of
from safe_wrappers.errors import Array

HAIR_M: Final = 1e-7
"""Extra distance of corrections, for rounding to float32."""
_NOISE_M: Final = 1e-12  # rounding of float64 between a path and the rest of it
_RECOVERY_S: Final = 0.1  # time constant, s, with which a violation must shrink from outside
_TURNS: Final = 4  # how many walls, one after another, a correction may have to turn away from
_HALVINGS: Final = 5  # steps back towards the proposal, where the path fits and not its rectangle


class At(NamedTuple):
    """The present state.

    Attributes:
        among: The point and the walls.
        motion: Clipped.
        room: The distance to keep from walls, m.
        left: What braking from the present motion leaves beyond it, m.
    """

    among: PointAmongWalls
    motion: PointMotion
    room: float
    left: float


@compiled
def _is_inside(at: At) -> bool:
    return at.left >= -HAIR_M


@compiled
def _left_after(at: At, control: Pair) -> float:
    """What is left after a control step, its own way not counted: it starts outside."""
    return distance(at.among, step(at.among, at.motion, control[0], control[1])) - at.room


@compiled
def _stopped_at(at: At, axis: int, wall: Rectangle, before: bool, gap: float) -> float:
    """The control along an axis, within its bounds, whose rest point is this far before or behind a wall."""
    constants, x, v = at.among.x_axis, at.motion.x, at.motion.vx
    if axis == 1:
        constants, x, v = at.among.y_axis, at.motion.y, at.motion.vy
    start, end = (wall[2], wall[3]) if axis == 1 else (wall[0], wall[1])
    target = start - gap if before else end + gap
    return max(constants.low, min(along.control_to_rest_at(constants, x, v, target), constants.high))


@compiled
def backup(at: At) -> Pair:
    """Braking; from outside the safe set, along the shortest way back to rest just inside it."""
    halt = brake(at.among, at.motion)
    if _is_inside(at):
        return halt
    around = stop(at.among, step(at.among, at.motion, halt[0], halt[1]))
    found = nearest(around, at.among.walls, math.inf)[1]
    if found < 0:  # the state is not a number
        return halt
    wall = one_of(at.among.walls, found)
    across, beside = gaps(around, wall)
    if across >= beside:
        before = around[1] - wall[0] <= wall[1] - around[0]
        return _stopped_at(at, 0, wall, before, at.room + HAIR_M), halt[1]
    before = around[3] - wall[2] <= wall[3] - around[2]
    return halt[0], _stopped_at(at, 1, wall, before, at.room + HAIR_M)


@compiled
def _recovery(at: At) -> float:
    """What a control must leave from outside the safe set."""
    axis = at.among.x_axis
    target = at.left * math.exp(-axis.timestep * axis.substeps / _RECOVERY_S)
    return min(target, _left_after(at, backup(at)))


@compiled
def admits(at: At, control: Pair, spare: float) -> bool:
    """Whether a control keeps the room, and `spare` beyond it, m; from outside: whether it shrinks the violation.

    Where `left` is not a number nothing is admitted: it is not inside, and no comparison with it is true.
    """
    if not _is_inside(at):
        needed = _recovery(at)
        return _left_after(at, control) >= needed - _NOISE_M
    # Rounding may have taken a hair of the room: braking, which takes nothing, is admitted all the same.
    extra = spare if spare > 0.0 else min(0.0, at.left) - _NOISE_M
    return clear(at.among, at.motion, control[0], control[1], at.room + extra)


@compiled
def _replaced(control: Pair, axis: int, value: float) -> Pair:
    return (value, control[1]) if axis == 0 else (control[0], value)


@compiled
def _aside(
    at: At,
    control: Pair,
    around: Rectangle,
    wall: Rectangle,
    axis: int,
) -> Pair:
    """The control nearest to this one that stays clear of a wall by less along one axis; NaN: there is none."""
    place, start, end, now = at.motion.x, wall[0], wall[1], control[0]
    if axis == 1:
        place, start, end, now = at.motion.y, wall[2], wall[3], control[1]
    before, behind = place < start, place > end
    if before or behind:
        # At a corner the gap along the other axis counts too: the distance is Euclidean.
        across, beside = gaps(around, wall)
        other = max(across if axis == 1 else beside, 0.0)
        room = at.room + HAIR_M
        gap = math.sqrt(max(room * room - other * other, 0.0))
        limit = _stopped_at(at, axis, wall, before, gap)
        if (limit < now) if before else (limit > now):
            return _replaced(control, axis, limit)
    return math.nan, math.nan


@compiled
def _turned(at: At, asked: Pair) -> Array:
    """Controls whose rectangle is clear, by limiting one axis or the other at each wall in the way, shape (k, 2)."""
    todo, found = np.empty((2 * _TURNS + 2, 3)), np.empty((2**_TURNS, 2))
    waiting, count = 1, 0
    todo[0, 0], todo[0, 1], todo[0, 2] = asked[0], asked[1], _TURNS
    while waiting > 0:
        waiting -= 1
        control, turns = (todo[waiting, 0], todo[waiting, 1]), todo[waiting, 2]
        around = reached(at.among, at.motion, control[0], control[1])
        index = nearest(around, at.among.walls, at.room + 0.5 * HAIR_M)[1]
        if index < 0:
            found[count, 0], found[count, 1] = control
            count += 1
        elif turns > 0.0:
            wall = one_of(at.among.walls, index)
            for axis in (1, 0):  # the last one is taken first
                way = _aside(at, control, around, wall, axis)
                if way[0] == way[0]:
                    todo[waiting, 0], todo[waiting, 1], todo[waiting, 2] = way[0], way[1], turns - 1.0
                    waiting += 1
    return found[:count]


@compiled
def _between(admitted: Pair, asked: Pair, share: float) -> Pair:
    x, y = admitted
    return x + share * (asked[0] - x), y + share * (asked[1] - y)


@compiled
def _towards(at: At, admitted: Pair, asked: Pair) -> Pair:
    """An admitted control, moved straight towards the one asked for as far as prediction allows."""
    low, high = 0.5**_HALVINGS, 1.0
    if not admits(at, _between(admitted, asked, low), HAIR_M):
        return admitted  # mostly: a wall straight ahead, and the rectangle was exact
    if admits(at, asked, HAIR_M):
        return asked
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        if admits(at, _between(admitted, asked, middle), HAIR_M):
            low = middle
        else:
            high = middle
    return _between(admitted, asked, low)


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
def _at(scene: Scene, motion: Array, left: float) -> At:
    now = PointMotion(motion[0], motion[1], motion[2], motion[3])
    return At(_in(scene), now, scene[0][0, 14], left)


@compiled
def _pair(scene: Scene, control: Array) -> Pair:
    return control[int(scene[0][0, 13])], control[int(scene[0][1, 13])]


@compiled
def room_left(scene: Scene, qpos: Array, qvel: Array, motion: Array) -> float:
    """What braking leaves beyond the room, m; NaN if the state is not finite. Writes the clipped motion, (4,)."""
    among, numbers = _in(scene), scene[0]
    for axis in range(2):
        motion[axis] = qpos[int(numbers[axis, 12])] + numbers[axis, 11]
        motion[2 + axis] = qvel[int(numbers[axis, 12])]
    now = clipped(among, PointMotion(motion[0], motion[1], motion[2], motion[3]))
    finite = math.isfinite(motion[0] + motion[1] + motion[2] + motion[3])
    motion[2], motion[3] = now.vx, now.vy
    return distance(among, now) - numbers[0, 14] if finite else math.nan


@compiled
def is_admitted(scene: Scene, motion: Array, left: float, control: Array) -> bool:
    """Whether a control, shape (m,), keeps the room, or from outside shrinks the violation."""
    return admits(_at(scene, motion, left), _pair(scene, control), 0.0)


@compiled
def candidates(scene: Scene, motion: Array, left: float, control: Array) -> Array:
    """Admissible pairs near a refused control, the nearest first: those that slide along walls in its way, (k, 2)."""
    at, pair = _at(scene, motion, left), _pair(scene, control)
    x_axis, y_axis = at.among.x_axis, at.among.y_axis
    asked = max(x_axis.low, min(pair[0], x_axis.high)), max(y_axis.low, min(pair[1], y_axis.high))
    turned, count = np.empty((0, 2)), 0
    if _is_inside(at):
        turned = _turned(at, asked)
    found = np.empty((len(turned) + 2, 2))
    for i in range(len(turned)):
        one = turned[i, 0], turned[i, 1]
        if admits(at, one, 0.0):
            if at.among.clip_known:
                one = _towards(at, one, asked)
            found[count, 0], found[count, 1] = one
            count += 1
    if count == 0:  # where the path fits and no rectangle does
        for first in range(2):
            one = backup(at)
            for axis in (first, 1 - first):
                one = _towards(at, one, _replaced(one, axis, asked[axis]))
            found[count, 0], found[count, 1] = one
            count += 1
    away = np.empty(count)
    for i in range(count):
        away[i] = hypot(found[i, 0] - asked[0], found[i, 1] - asked[1])
    return found[np.argsort(away, kind="mergesort")]  # of equally near ones the first stays first


@compiled
def backup_pair(scene: Scene, motion: Array, left: float) -> Pair:
    """The pair that is always admitted: brake both axes. From outside it leads back inside."""
    return backup(_at(scene, motion, left))


@compiled
def half_spaces(scene: Scene, motion: Array, left: float) -> tuple[Array, Array]:
    """A convex part of what is admitted, braking included: normals of the pair (k, 2) and offsets (k,)."""
    at = _at(scene, motion, left)
    halt, wanted = backup(at), at.room + HAIR_M
    around, area = reached(at.among, at.motion, halt[0], halt[1]), reachable(at.among, at.motion)
    normals, offsets, count = np.zeros((2 * len(at.among.walls), 2)), np.zeros(2 * len(at.among.walls)), 0
    index = closer(area, at.among.walls, wanted, 0)
    while index >= 0:
        wall = one_of(at.among.walls, index)
        gap = gaps(around, wall)
        corner = 0.0 < gap[0] < wanted and 0.0 < gap[1] < wanted
        # At a corner both axes keep their share of the distance; else the one with more room keeps it all.
        share = min(1.0, wanted / hypot(gap[0], gap[1])) if corner else 0.0
        more = 1 if gap[1] > gap[0] else 0
        for axis in range(2):
            if not corner and axis != more:
                continue
            start, end, from_, to = wall[0], wall[1], around[0], around[1]
            if axis == 1:
                start, end, from_, to = wall[2], wall[3], around[2], around[3]
            before = start - to >= from_ - end
            sign = 1.0 if before else -1.0
            limit = _stopped_at(at, axis, wall, before, share * gap[axis] if corner else wanted)
            normals[count, axis] = sign
            offsets[count] = max(sign * limit, sign * halt[axis])
            count += 1
        index = closer(area, at.among.walls, wanted, index + 1)
    return normals[:count], offsets[:count]
