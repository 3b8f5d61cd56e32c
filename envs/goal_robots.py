"""The goal task's robots, the part that differs from machine to machine, and the pseudo-lidar that all have.

A robot's first two coordinates are the world x and y of its centre, m.
"""

import math
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.errors import Array

LIDAR_BINS: Final = 16
"""Directions per object kind; bin i spans [i, i + 1] * 2 pi / 16 counter-clockwise from straight ahead."""
LIDAR_RANGE: Final = 3.0
"""Distance from which on an object reads 0, m."""

_NEIGHBOURS: Final = np.array([[0], [1], [-1]])
_DIRECT: Final = 15  # sensors that are observed as they are; the caster's quaternion follows them
_HEIGHT: Final = 0.1  # m: of the car's centre where its wheels touch the floor
_QUARTER_TURN: Final = math.pi / 2.0


class PlanarRobot:
    """A sphere that pushes along its heading and turns, with a box for a nose; its joints are world x, y and heading.

    The root body of a robot is called "agent"; every geom in its subtree counts as the robot.
    """

    name: Final = "point"  # prefix of its assets: <name>_goal<level>.xml
    n_sensors: Final = 12  # that open the observation: accelerometer, velocimeter, gyro, magnetometer

    def place(self, qpos: Array, pose: Array) -> None:
        """Stand at a pose: x, y, heading, shape (3,), m and rad."""
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


class WheeledCar:
    """Safety-Gymnasium's car, on a free joint, which opens the configuration: x, y, z, quaternion.

    Its wheels' axle is the x axis of its body, and positive controls drive it along -y: `heading` is that
    direction. Its lidar counts from the x axis, as the original's does: bin 0 looks to the heading's left.
    """

    name: Final = "car"
    n_sensors: Final = 24  # as the point's 12, then the caster's turning and its 3 x 3 orientation
    hull_corners: Final = ((0.1, -0.1), (0.1, 0.16), (0.05, -0.175), (0.155, 0.15), (0.155, 0.05))
    """Outline in its frame seen from above, m: the chassis, the bumpers, back and front, the wheels' outer rims."""

    def place(self, qpos: Array, pose: Array) -> None:
        x, y, heading = pose.tolist()
        half = (heading + _QUARTER_TURN) / 2.0
        qpos[:7] = x, y, _HEIGHT, math.cos(half), 0.0, 0.0, math.sin(half)

    def heading(self, qpos: Array) -> float:
        """Direction of the body's -y axis seen from above, in [-pi, pi], rad."""
        rotation = _rotation(qpos[3:7])
        return math.atan2(-rotation[1, 1], -rotation[0, 1])

    def sensors(self, data: mujoco.MjData) -> Array:
        readings = data.sensordata
        return np.concatenate([readings[:_DIRECT], _rotation(readings[_DIRECT : _DIRECT + 4]).ravel()])

    def relative(self, points: Array, qpos: Array) -> Array:
        """Points of the floor in the body's frame, tilt and height included; the first two coordinates, m."""
        offsets = np.empty((len(points), 3))
        offsets[:, :2] = points - qpos[:2]
        offsets[:, 2] = -qpos[2]
        turned: Array = offsets @ _rotation(qpos[3:7])[:, :2]
        return turned


def _rotation(quaternion: Array) -> Array:
    """A quaternion's rotation matrix, shape (3, 3); of no rotation where the quaternion is zero."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


POINT: Final = PlanarRobot()
CAR: Final = WheeledCar()
Robot = PlanarRobot | WheeledCar


def pseudo_lidar(
    relative: Array, kinds: NDArray[np.intp], n_kinds: int, max_dist: float = LIDAR_RANGE
) -> Array:
    """Read the lidars of all object kinds at once: readings in [0, 1], shape (n_kinds * 16,), kind after kind.

    An object at distance d in bin i reads s = max(0, 1 - d / max_dist) there. It also reads into both
    neighbours, so that the picture changes smoothly as it crosses a border: with a in [0, 1) its place inside
    the bin, bin i + 1 gets a * s and bin i - 1 gets (1 - a) * s. Each bin keeps its largest reading.

    Args:
        relative: Object centres in the robot's frame (x ahead, y to the left), shape (n, 2), m.
        kinds: Kind of each object, shape (n,), in [0, n_kinds).
        n_kinds: Number of kinds.
        max_dist: Range, m.
    """
    readings = np.zeros(n_kinds * LIDAR_BINS)
    strength = np.maximum(0.0, max_dist - np.hypot(relative[:, 0], relative[:, 1])) / max_dist
    sector = np.arctan2(relative[:, 1], relative[:, 0]) % (2 * np.pi) / (2 * np.pi / LIDAR_BINS)
    index = sector.astype(np.intp)
    place = sector - index
    # The modulo also catches an angle just below zero, whose remainder rounds up to a full turn.
    target = (index + _NEIGHBOURS) % LIDAR_BINS + kinds * LIDAR_BINS
    np.maximum.at(readings, target, np.stack([strength, place * strength, (1 - place) * strength]))
    return readings
