"""A point mass on two axes among rectangular walls: the area swept by one control step and the braking after it.

Each axis brakes separately (`damped_axis.py`). The path is covered by one rectangle per hold, which are fewer after
each hold, so the distance from the walls never falls. If the level of the env's speed clip is not known, a single
rectangle from the present position to the rest point is used: it contains the path for every clip above what one hold
of full force can reverse.
"""

import math
from typing import NamedTuple

import numpy as np

from safe_wrappers.control.backup import damped_axis as along
from safe_wrappers.control.backup.damped_axis import DampedAxis
from safe_wrappers.control.compiled import compiled
from safe_wrappers.control.numerics.shapes import Rectangle, apart, closer, nearest, one_of
from safe_wrappers.errors import Array

Pair = tuple[float, float]
"""Numbers along x and along y."""


class PointMotion(NamedTuple):
    """Position (m) and velocity (m/s) of a point."""

    x: float
    y: float
    vx: float
    vy: float


class PointAmongWalls(NamedTuple):
    """Two axes and the walls.

    Attributes:
        x_axis, y_axis: Constants of the motion.
        walls: Rectangles, m, shape (n, 4).
        clip_known: The axes' `clip` is the env's own; then the path counts, not only the rectangle around it.
    """

    x_axis: DampedAxis
    y_axis: DampedAxis
    walls: Array
    clip_known: bool


@compiled
def clipped(among: PointAmongWalls, motion: PointMotion) -> PointMotion:
    """The motion after the env's clip."""
    vx, vy = along.clipped(among.x_axis, motion.vx), along.clipped(among.y_axis, motion.vy)
    return PointMotion(motion.x, motion.y, vx, vy)


@compiled
def step(among: PointAmongWalls, motion: PointMotion, ux: float, uy: float) -> PointMotion:
    """The motion after one control step; `motion` is already clipped."""
    x, vx = along.step(among.x_axis, motion.x, motion.vx, ux)
    y, vy = along.step(among.y_axis, motion.y, motion.vy, uy)
    return PointMotion(x, y, vx, vy)


@compiled
def rest(among: PointAmongWalls, motion: PointMotion) -> Pair:
    """Position at which braking comes to rest, m."""
    return along.rest(among.x_axis, motion.x, motion.vx), along.rest(among.y_axis, motion.y, motion.vy)


@compiled
def brake(among: PointAmongWalls, motion: PointMotion) -> Pair:
    """The control of the next hold of braking."""
    return along.brake(among.x_axis, motion.vx), along.brake(among.y_axis, motion.vy)


@compiled
def _spanned(x: float, y: float, to_x: float, to_y: float) -> Rectangle:
    """Rectangle spanned by two points."""
    return min(x, to_x), max(x, to_x), min(y, to_y), max(y, to_y)


@compiled
def held(among: PointAmongWalls, motion: PointMotion, ux: float, uy: float) -> Rectangle:
    """Rectangle that contains one control step; `motion` is already clipped."""
    x0, x1 = along.extent(among.x_axis, motion.x, motion.vx, ux)
    y0, y1 = along.extent(among.y_axis, motion.y, motion.vy, uy)
    return x0, x1, y0, y1


@compiled
def stop(among: PointAmongWalls, motion: PointMotion) -> Rectangle:
    """Rectangle that contains braking, from the present position to the rest point."""
    end_x, end_y = rest(among, motion)
    return _spanned(motion.x, motion.y, end_x, end_y)


@compiled
def reached(among: PointAmongWalls, motion: PointMotion, ux: float, uy: float) -> Rectangle:
    """Rectangle that contains one control step and the braking after it."""
    x0, x1, y0, y1 = held(among, motion, ux, uy)
    end_x, end_y = rest(among, step(among, motion, ux, uy))
    return min(x0, end_x), max(x1, end_x), min(y0, end_y), max(y1, end_y)


@compiled
def reachable(among: PointAmongWalls, motion: PointMotion) -> Rectangle:
    """Rectangle that contains what any control of one step can reach."""
    # Positions grow with the control along each axis, so the two extreme controls bound all.
    x_axis, y_axis = among.x_axis, among.y_axis
    low = reached(among, motion, x_axis.low, y_axis.low)
    high = reached(among, motion, x_axis.high, y_axis.high)
    return low[0], high[1], low[2], high[3]


@compiled
def path(among: PointAmongWalls, motion: PointMotion) -> Array:
    """Rectangles that contain braking, shape (n, 4): one per hold, and the rest point."""
    xs = along.braking(among.x_axis, motion.x, motion.vx)
    ys = along.braking(among.y_axis, motion.y, motion.vy)
    n, last_x, last_y = max(len(xs), len(ys)), len(xs) - 1, len(ys) - 1
    found = np.empty((n, 4))
    for i in range(n):  # one axis may be at rest before the other
        x, to_x = xs[min(i, last_x)], xs[min(i + 1, last_x)]
        y, to_y = ys[min(i, last_y)], ys[min(i + 1, last_y)]
        found[i, 0], found[i, 1], found[i, 2], found[i, 3] = _spanned(x, y, to_x, to_y)
    return found


@compiled
def distance(among: PointAmongWalls, motion: PointMotion, enough: float = math.inf) -> float:
    """Distance of the braking path from the nearest wall, m, at most `enough`."""
    end_x, end_y = rest(among, motion)
    around = _spanned(motion.x, motion.y, end_x, end_y)
    best, wall = nearest(around, among.walls, enough)
    if wall < 0 or not among.clip_known or not math.isfinite(end_x + end_y):
        return best
    # The path contains its ends. Where one of them is as close as the rectangle, the path is, too.
    close = one_of(among.walls, wall)
    start = apart((motion.x, motion.x, motion.y, motion.y), close)
    ends = min(start, apart((end_x, end_x, end_y, end_y), close))
    if ends <= best:
        return best
    best, steps = min(ends, enough), path(among, motion)
    limit, wall = max(best, 0.0), -1
    while True:
        wall = closer(around, among.walls, limit, wall + 1)
        if wall < 0:
            return best
        for i in range(len(steps)):
            best = min(best, apart(one_of(steps, i), one_of(among.walls, wall)))


@compiled
def clear(among: PointAmongWalls, motion: PointMotion, ux: float, uy: float, room: float) -> bool:
    """Whether one control step and braking after it keep a distance `room` >= 0 from every wall."""
    if closer(reached(among, motion, ux, uy), among.walls, room) < 0:
        return True
    if not among.clip_known or closer(held(among, motion, ux, uy), among.walls, room) >= 0:
        return False
    return distance(among, step(among, motion, ux, uy), room) >= room
