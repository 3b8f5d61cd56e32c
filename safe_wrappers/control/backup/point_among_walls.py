"""A point mass on two axes among rectangular walls: where one control step and the braking after it take it.

The braking manoeuvre: each axis for itself, fully, and in its last hold just to rest (`held_axis.py`). Its path is
covered by rectangles, one per hold: within a hold of braking the motion along each axis has one sign, so the
rectangle between its ends contains it, between physics substeps too. After one hold of braking the manoeuvre is the
rest of itself, so its rectangles are a subset, and none has come closer to a wall.

An env may clip the speed at the start of a control step, which bends the path. If the level is known, the manoeuvre
starts from the clipped speed and the above holds. If not, one rectangle counts, from the present position to the
rest point: less speed along an axis never leads farther along it, and braking from less never ends beyond, so it
contains the path for every clip above what one hold of full force can reverse.
"""

import math
from dataclasses import dataclass
from itertools import pairwise, zip_longest
from typing import NamedTuple

from safe_wrappers.control.backup.damped_axis import HeldAxis
from safe_wrappers.control.numerics.rectangles import Rectangle, apart, closer, nearest


class PointMotion(NamedTuple):
    """Position (m) and velocity (m/s) of a point."""

    x: float
    y: float
    vx: float
    vy: float


@dataclass(frozen=True)
class PointAmongWalls:
    """The two axes and the walls.

    Attributes:
        x_axis, y_axis: Constants of the motion.
        walls: Rectangles, m.
        clip_known: The axes' `clip` is the env's, so that the path itself counts, not only the rectangle around it.
    """

    x_axis: HeldAxis
    y_axis: HeldAxis
    walls: list[Rectangle]
    clip_known: bool

    def clipped(self, motion: PointMotion) -> PointMotion:
        """The motion with which a control step starts."""
        x, y, vx, vy = motion
        return PointMotion(x, y, self.x_axis.clipped(vx), self.y_axis.clipped(vy))

    def step(self, motion: PointMotion, ux: float, uy: float) -> PointMotion:
        """The motion after one control step; it starts clipped."""
        x, vx = self.x_axis.step(motion.x, motion.vx, ux)
        y, vy = self.y_axis.step(motion.y, motion.vy, uy)
        return PointMotion(x, y, vx, vy)

    def rest(self, motion: PointMotion) -> tuple[float, float]:
        """Where braking comes to rest, m."""
        return self.x_axis.rest(motion.x, motion.vx), self.y_axis.rest(motion.y, motion.vy)

    def brake(self, motion: PointMotion) -> tuple[float, float]:
        """The control of the manoeuvre's next hold."""
        return self.x_axis.brake(motion.vx), self.y_axis.brake(motion.vy)

    def held(self, motion: PointMotion, ux: float, uy: float) -> Rectangle:
        """What one control step stays in; it starts clipped."""
        across = self.x_axis.extent(motion.x, motion.vx, ux)
        return *across, *self.y_axis.extent(motion.y, motion.vy, uy)

    def stop(self, motion: PointMotion) -> Rectangle:
        """What braking stays in: the rectangle between here and the rest point."""
        return _spanned(motion.x, motion.y, *self.rest(motion))

    def reached(self, motion: PointMotion, ux: float, uy: float) -> Rectangle:
        """What one control step and braking after it stay in."""
        x0, x1, y0, y1 = self.held(motion, ux, uy)
        end_x, end_y = self.rest(self.step(motion, ux, uy))
        return min(x0, end_x), max(x1, end_x), min(y0, end_y), max(y1, end_y)

    def reachable(self, motion: PointMotion, limit: float) -> list[Rectangle]:
        """The walls that some control of one step could bring closer than `limit`."""
        # Along each axis everything grows with the control, so the two extreme ones bound all.
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
        """Distance of the braking path from the nearest wall, m; nothing farther than `enough` is looked at."""
        end_x, end_y = self.rest(motion)
        around = _spanned(motion.x, motion.y, end_x, end_y)
        best, wall = nearest(around, self.walls, enough)
        if wall is None or not self.clip_known or not math.isfinite(end_x + end_y):
            return best
        # The path contains its ends. Often one of them is as close as the rectangle; then so is the path.
        start = apart((motion.x, motion.x, motion.y, motion.y), wall)
        ends = min(start, apart((end_x, end_x, end_y, end_y), wall))
        if ends <= best:
            return best
        best, steps = min(ends, enough), self.path(motion)
        for wall in closer(around, self.walls, max(best, 0.0)):
            best = min(best, *(apart(step, wall) for step in steps))
        return best

    def path(self, motion: PointMotion) -> list[Rectangle]:
        """What the braking manoeuvre stays in: one rectangle per hold, and the rest point."""
        across = self.x_axis.braking(motion.x, motion.vx)
        along = self.y_axis.braking(motion.y, motion.vy)
        points = zip_longest(across, along)  # one axis may be at rest before the other
        places = [(across[-1] if x is None else x, along[-1] if y is None else y) for x, y in points]
        return [_spanned(*start, *end) for start, end in pairwise([*places, places[-1]])]


def _spanned(x: float, y: float, to_x: float, to_y: float) -> Rectangle:
    """The rectangle between two points."""
    return min(x, to_x), max(x, to_x), min(y, to_y), max(y, to_y)
