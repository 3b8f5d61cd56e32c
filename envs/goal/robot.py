"""What the goal task needs to know of a robot: the part that differs from machine to machine."""

import math
from dataclasses import dataclass
from typing import Final, Protocol

import mujoco
import numpy as np

from safe_wrappers.checks import Array


class Robot(Protocol):
    """A machine whose first two coordinates are the world x and y of its centre, m."""

    @property
    def name(self) -> str:
        """Prefix of its assets: ``<name>_goal<level>.xml``."""

    @property
    def body(self) -> str:
        """Name of its root body; every geom in its subtree counts as the robot."""

    @property
    def n_sensors(self) -> int:
        """How many numbers its sensors put at the front of the observation."""

    @property
    def radius(self) -> float:
        """Largest horizontal distance of any point of the robot from its centre, m."""

    def place(self, qpos: Array, pose: Array) -> None:
        """Write its pose, shape (3,): x, y (m) and heading (rad), into the configuration, shape (nq,)."""

    def heading(self, qpos: Array) -> float:
        """Heading in a configuration, shape (nq,): where positive controls drive it, in [-pi, pi], rad."""

    def sensors(self, data: mujoco.MjData) -> Array:
        """Sensor readings, shape (n_sensors,)."""

    def relative(self, points: Array, qpos: Array) -> Array:
        """Points on the floor in its lidar's frame; shape (n, 2) both, m."""


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
    def radius(self) -> float:
        """Largest distance of any point of the robot from its turning axis, m."""
        return max(self.hull_radius, *(math.hypot(x, y) for x, y in self.hull_corners))

    def place(self, qpos: Array, pose: Array) -> None:
        """The pose is the first three coordinates."""
        qpos[:3] = pose

    def heading(self, qpos: Array) -> float:
        """The third coordinate, in [-pi, pi], rad."""
        return math.remainder(qpos[2], math.tau)

    def sensors(self, data: mujoco.MjData) -> Array:
        """The first readings of the model."""
        readings: Array = data.sensordata[: self.n_sensors]
        return readings

    def relative(self, points: Array, qpos: Array) -> Array:
        """Points with x along the heading and y to its left, shape (n, 2), m."""
        x, y, heading = qpos[:3].tolist()
        cos, sin = math.cos(heading), math.sin(heading)
        turned: Array = (points - (x, y)) @ np.array([[cos, -sin], [sin, cos]])
        return turned


POINT: Final = PlanarRobot(
    name="point",
    body="agent",
    n_sensors=12,  # accelerometer, velocimeter, gyro, magnetometer
    hull_radius=0.1,
    hull_corners=((0.15, 0.05), (0.15, -0.05)),
)
"""A sphere that pushes along its heading and turns, with a box for a nose."""
