"""What the goal task needs to know of a robot: the part that differs from machine to machine."""

import math
from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class PlanarRobot:
    """A robot whose first three joints are world x, world y and heading.

    Attributes:
        name: Prefix of its assets: ``<name>_goal<level>.xml``.
        body: Name of its root body; every geom in its subtree counts as the robot.
        n_sensors: Length of its sensors' readings, which open the observation.
        hull_radius: Radius of its main body around the turning axis, m.
        hull_corners: Points of its outline beyond that radius, in its frame, m.
    """

    name: str
    body: str
    n_sensors: int
    hull_radius: float
    hull_corners: tuple[tuple[float, float], ...]

    @property
    def reach(self) -> float:
        """Largest distance of any point of the robot from its turning axis, m."""
        return max(self.hull_radius, *(math.hypot(x, y) for x, y in self.hull_corners))


POINT: Final = PlanarRobot(
    name="point",
    body="agent",
    n_sensors=12,  # accelerometer, velocimeter, gyro, magnetometer
    hull_radius=0.1,
    hull_corners=((0.15, 0.05), (0.15, -0.05)),
)
"""A sphere that pushes along its heading and turns, with a box for a nose."""
