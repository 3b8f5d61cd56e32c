"""A point mass on two axes among rectangular walls: the area swept by one control step and the braking after it.

Each axis brakes separately (`damped_axis.py`). The path is covered by one rectangle per hold, which are fewer after
each hold, so the distance from the walls never falls. If the level of the env's speed clip is not known, a single
rectangle from the present position to the rest point is used: it contains the path for every clip above what one hold
of full force can reverse.
"""

import math
from dataclasses import dataclass
from itertools import pairwise, zip_longest
from typing import NamedTuple

from safe_wrappers.control.backup.damped_axis import DampedAxis
from safe_wrappers.control.numerics.rectangles import Rectangle, apart, closer, nearest


class PointMotion(NamedTuple):
    """Position (m) and velocity (m/s) of a point."""

    x: float
    y: float
    vx: float
    vy: float


@dataclass(frozen=True)
class PointAmongWalls:
    """Two axes and the walls.

    Attributes:
        x_axis, y_axis: Constants of the motion.
        walls: Rectangles, m.
        clip_known: The axes' `clip` is the env's own; then the path counts, not only the rectangle around it.
    """

    x_axis: DampedAxis
    y_axis: DampedAxis
    walls: list[Rectangle]
    clip_known: bool

    def clipped(self, motion: PointMotion) -> PointMotion:
        """The motion after the env's clip."""
        x, y, vx, vy = motion
        return PointMotion(x, y, self.x_axis.clipped(vx), self.y_axis.clipped(vy))

    def step(self, motion: PointMotion, ux: float, uy: float) -> PointMotion:
        """The motion after one control step; `motion` is already clipped."""
        x, vx = self.x_axis.step(motion.x, motion.vx, ux)
        y, vy = self.y_axis.step(motion.y, motion.vy, uy)
        return PointMotion(x, y, vx, vy)

    def rest(self, motion: PointMotion) -> tuple[float, float]:
        """Position at which braking comes to rest, m."""
        return self.x_axis.rest(motion.x, motion.vx), self.y_axis.rest(motion.y, motion.vy)

    def brake(self, motion: PointMotion) -> tuple[float, float]:
        """The control of the next hold of braking."""
        return self.x_axis.brake(motion.vx), self.y_axis.brake(motion.vy)

    def held(self, motion: PointMotion, ux: float, uy: float) -> Rectangle:
        """Rectangle that contains one control step; `motion` is already clipped."""
        across = self.x_axis.extent(motion.x, motion.vx, ux)
        return *across, *self.y_axis.extent(motion.y, motion.vy, uy)

    def stop(self, motion: PointMotion) -> Rectangle:
        """Rectangle that contains braking, from the present position to the rest point."""
        return _spanned(motion.x, motion.y, *self.rest(motion))

    def reached(self, motion: PointMotion, ux: float, uy: float) -> Rectangle:
        """Rectangle that contains one control step and the braking after it."""
        x0, x1, y0, y1 = self.held(motion, ux, uy)
        end_x, end_y = self.rest(self.step(motion, ux, uy))
        return min(x0, end_x), max(x1, end_x), min(y0, end_y), max(y1, end_y)

    def reachable(self, motion: PointMotion, limit: float) -> list[Rectangle]:
        """The walls that some control of one step could bring closer than `limit`, m."""
        # Positions grow with the control along each axis, so the two extreme controls bound all.
        low = self.reached(motion, self.x_axis.low, self.y_axis.low)
        high = self.reached(motion, self.x_axis.high, self.y_axis.high)
        return closer((low[0], high[1], low[2], high[3]), self.walls, limit)

    def clear(self, motion: PointMotion, ux: float, uy: float, distance: float) -> bool:
        """Whether one control step and braking after it keep a distance >= 0 from every wall."""
        if not closer(self.reached(motion, ux, uy), self.walls, distance):
            return True
        if not self.clip_known or closer(self.held(motion, ux, uy), self.walls, distance):
            return False
        return self.distance(self.step(motion, ux, uy), distance) >= distance

    def distance(self, motion: PointMotion, enough: float = math.inf) -> float:
        """Distance of the braking path from the nearest wall, m, at most `enough`."""
        end_x, end_y = self.rest(motion)
        around = _spanned(motion.x, motion.y, end_x, end_y)
        best, wall = nearest(around, self.walls, enough)
        if wall is None or not self.clip_known or not math.isfinite(end_x + end_y):
            return best
        # The path contains its ends. Where one of them is as close as the rectangle, the path is, too.
        start = apart((motion.x, motion.x, motion.y, motion.y), wall)
        ends = min(start, apart((end_x, end_x, end_y, end_y), wall))
        if ends <= best:
            return best
        best, steps = min(ends, enough), self.path(motion)
        for wall in closer(around, self.walls, max(best, 0.0)):
            best = min(best, *(apart(step, wall) for step in steps))
        return best

    def path(self, motion: PointMotion) -> list[Rectangle]:
        """Rectangles that contain braking: one per hold, and the rest point."""
        across = self.x_axis.braking(motion.x, motion.vx)
        along = self.y_axis.braking(motion.y, motion.vy)
        points = zip_longest(across, along)  # one axis may be at rest before the other
        places = [(across[-1] if x is None else x, along[-1] if y is None else y) for x, y in points]
        return [_spanned(*start, *end) for start, end in pairwise([*places, places[-1]])]


def _spanned(x: float, y: float, to_x: float, to_y: float) -> Rectangle:
    """Rectangle spanned by two points."""
    return min(x, to_x), max(x, to_x), min(y, to_y), max(y, to_y)
