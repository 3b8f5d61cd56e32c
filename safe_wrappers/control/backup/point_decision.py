"""Which controls leave a point mass among walls its way to rest, and the closest one to a refused one.

`room` is the distance to keep from walls, `left` what braking from the present motion leaves beyond it, m. From
outside the safe set (`left` below zero) the violation has to shrink.
"""

import math
from typing import Final

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.control.backup import damped_axis as along
from safe_wrappers.control.backup.point_among_walls import (
    Pair,
    PointAmongWalls,
    PointMotion,
    brake,
    clear,
    distance,
    reachable,
    reached,
    step,
    stop,
)
from safe_wrappers.control.numerics.compiled import compiled, hypot
from safe_wrappers.control.numerics.planar import Rectangle, closer, gaps, nearest, one_of

HAIR_M: Final = 1e-7
"""Extra distance of corrections, for rounding to float32."""
_NOISE_M: Final = 1e-12  # rounding of float64 between a path and the rest of it
_RECOVERY_S: Final = 0.1  # time constant, s, with which a violation must shrink from outside
_TURNS: Final = 4  # how many walls, one after another, a correction may have to turn away from
_HALVINGS: Final = 5  # steps back towards the proposal, where the path fits and not its rectangle


@compiled
def _is_inside(left: float) -> bool:
    return left >= -HAIR_M


@compiled
def _left_after(among: PointAmongWalls, motion: PointMotion, room: float, control: Pair) -> float:
    """What is left after a control step, its own way not counted: it starts outside."""
    return distance(among, step(among, motion, control[0], control[1])) - room


@compiled
def _stopped_at(
    among: PointAmongWalls, motion: PointMotion, axis: int, wall: Rectangle, before: bool, gap: float
) -> float:
    """The control along an axis, within its bounds, whose rest point is this far before or behind a wall."""
    constants, x, v = among.x_axis, motion.x, motion.vx
    if axis == 1:
        constants, x, v = among.y_axis, motion.y, motion.vy
    start, end = (wall[2], wall[3]) if axis == 1 else (wall[0], wall[1])
    target = start - gap if before else end + gap
    return max(constants.low, min(along.control_to_rest_at(constants, x, v, target), constants.high))


@compiled
def backup(among: PointAmongWalls, motion: PointMotion, room: float, left: float) -> Pair:
    """Braking; from outside the safe set, along the shortest way back to rest just inside it."""
    halt = brake(among, motion)
    if _is_inside(left):
        return halt
    around = stop(among, step(among, motion, halt[0], halt[1]))
    found = nearest(around, among.walls, math.inf)[1]
    if found < 0:  # the state is not a number
        return halt
    wall = one_of(among.walls, found)
    across, beside = gaps(around, wall)
    if across >= beside:
        before = around[1] - wall[0] <= wall[1] - around[0]
        return _stopped_at(among, motion, 0, wall, before, room + HAIR_M), halt[1]
    before = around[3] - wall[2] <= wall[3] - around[2]
    return halt[0], _stopped_at(among, motion, 1, wall, before, room + HAIR_M)


@compiled
def _recovery(among: PointAmongWalls, motion: PointMotion, room: float, left: float) -> float:
    """What a control must leave from outside the safe set."""
    axis = among.x_axis
    target = left * math.exp(-axis.timestep * axis.substeps / _RECOVERY_S)
    return min(target, _left_after(among, motion, room, backup(among, motion, room, left)))


@compiled
def admits(
    among: PointAmongWalls, motion: PointMotion, room: float, left: float, control: Pair, spare: float
) -> bool:
    """Whether a control keeps the room, and `spare` beyond it, m; from outside: whether it shrinks the violation.

    Where `left` is not a number nothing is admitted: it is not inside, and no comparison with it is true.
    """
    if not _is_inside(left):
        needed = _recovery(among, motion, room, left)
        return _left_after(among, motion, room, control) >= needed - _NOISE_M
    # Rounding may have taken a hair of the room: braking, which takes nothing, is admitted all the same.
    extra = spare if spare > 0.0 else min(0.0, left) - _NOISE_M
    return clear(among, motion, control[0], control[1], room + extra)


@compiled
def _replaced(control: Pair, axis: int, value: float) -> Pair:
    return (value, control[1]) if axis == 0 else (control[0], value)


@compiled
def _aside(
    among: PointAmongWalls,
    motion: PointMotion,
    room: float,
    control: Pair,
    around: Rectangle,
    wall: Rectangle,
    axis: int,
) -> Pair:
    """The control nearest to this one that stays clear of a wall by less along one axis; NaN: there is none."""
    at, start, end, now = motion.x, wall[0], wall[1], control[0]
    if axis == 1:
        at, start, end, now = motion.y, wall[2], wall[3], control[1]
    before, behind = at < start, at > end
    if before or behind:
        # At a corner the gap along the other axis counts too: the distance is Euclidean.
        across, beside = gaps(around, wall)
        other = max(across if axis == 1 else beside, 0.0)
        gap = math.sqrt(max(room * room - other * other, 0.0))
        limit = _stopped_at(among, motion, axis, wall, before, gap)
        if (limit < now) if before else (limit > now):
            return _replaced(control, axis, limit)
    return math.nan, math.nan


@compiled
def _turned(among: PointAmongWalls, motion: PointMotion, room: float, asked: Pair) -> Array:
    """Controls whose rectangle is clear, by limiting one axis or the other at each wall in the way, shape (k, 2)."""
    todo, found = np.empty((2 * _TURNS + 2, 3)), np.empty((2**_TURNS, 2))
    waiting, count = 1, 0
    todo[0, 0], todo[0, 1], todo[0, 2] = asked[0], asked[1], _TURNS
    while waiting > 0:
        waiting -= 1
        control, turns = (todo[waiting, 0], todo[waiting, 1]), todo[waiting, 2]
        around = reached(among, motion, control[0], control[1])
        index = nearest(around, among.walls, room + 0.5 * HAIR_M)[1]
        if index < 0:
            found[count, 0], found[count, 1] = control
            count += 1
        elif turns > 0.0:
            wall = one_of(among.walls, index)
            for axis in (1, 0):  # the last one is taken first
                way = _aside(among, motion, room + HAIR_M, control, around, wall, axis)
                if way[0] == way[0]:
                    todo[waiting, 0], todo[waiting, 1], todo[waiting, 2] = way[0], way[1], turns - 1.0
                    waiting += 1
    return found[:count]


@compiled
def _between(admitted: Pair, asked: Pair, share: float) -> Pair:
    x, y = admitted
    return x + share * (asked[0] - x), y + share * (asked[1] - y)


@compiled
def _towards(
    among: PointAmongWalls, motion: PointMotion, room: float, left: float, admitted: Pair, asked: Pair
) -> Pair:
    """An admitted control, moved straight towards the one asked for as far as prediction allows."""
    low, high = 0.5**_HALVINGS, 1.0
    if not admits(among, motion, room, left, _between(admitted, asked, low), HAIR_M):
        return admitted  # mostly: a wall straight ahead, and the rectangle was exact
    if admits(among, motion, room, left, asked, HAIR_M):
        return asked
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        if admits(among, motion, room, left, _between(admitted, asked, middle), HAIR_M):
            low = middle
        else:
            high = middle
    return _between(admitted, asked, low)


@compiled
def near(among: PointAmongWalls, motion: PointMotion, room: float, left: float, control: Pair) -> Array:
    """Admissible controls near a refused one, the nearest first: those that slide along the walls in its way."""
    x_axis, y_axis = among.x_axis, among.y_axis
    asked = max(x_axis.low, min(control[0], x_axis.high)), max(y_axis.low, min(control[1], y_axis.high))
    turned, count = np.empty((0, 2)), 0
    if _is_inside(left):
        turned = _turned(among, motion, room, asked)
    found, away = np.empty((len(turned) + 2, 2)), np.empty(len(turned) + 2)
    for i in range(len(turned)):
        one = turned[i, 0], turned[i, 1]
        if admits(among, motion, room, left, one, 0.0):
            if among.clip_known:
                one = _towards(among, motion, room, left, one, asked)
            found[count, 0], found[count, 1] = one
            count += 1
    if count == 0:  # where the path fits and no rectangle does
        for first in range(2):
            one = backup(among, motion, room, left)
            for axis in (first, 1 - first):
                one = _towards(among, motion, room, left, one, _replaced(one, axis, asked[axis]))
            found[count, 0], found[count, 1] = one
            count += 1
    for i in range(count):  # sorted by insertion: of equally near ones the first stays first
        one = found[i, 0], found[i, 1]
        far, place = hypot(one[0] - asked[0], one[1] - asked[1]), i
        while place > 0 and away[place - 1] > far:
            away[place] = away[place - 1]
            found[place, 0], found[place, 1] = found[place - 1, 0], found[place - 1, 1]
            place -= 1
        away[place], found[place, 0], found[place, 1] = far, one[0], one[1]
    return found[:count]


@compiled
def bounds(among: PointAmongWalls, motion: PointMotion, room: float, left: float) -> tuple[Array, Array]:
    """A convex part of what is admitted, braking included, as half-spaces: normals (k, 2) and offsets (k,)."""
    halt, wanted = backup(among, motion, room, left), room + HAIR_M
    around, area = reached(among, motion, halt[0], halt[1]), reachable(among, motion)
    normals, offsets, count = np.zeros((2 * len(among.walls), 2)), np.zeros(2 * len(among.walls)), 0
    index = closer(area, among.walls, wanted, 0)
    while index >= 0:
        wall = one_of(among.walls, index)
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
            limit = _stopped_at(among, motion, axis, wall, before, share * gap[axis] if corner else wanted)
            normals[count, axis] = sign
            offsets[count] = max(sign * limit, sign * halt[axis])
            count += 1
        index = closer(area, among.walls, wanted, index + 1)
    return normals[:count], offsets[:count]
