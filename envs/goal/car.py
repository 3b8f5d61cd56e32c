"""The car of the goal task: two driven wheels and a ball caster under a box, free to tilt and to slide."""

import math
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

from safe_wrappers.checks import Array

_DIRECT: Final = 15  # sensors that are observed as they are; the caster's quaternion follows them
_HEIGHT: Final = 0.1  # m: of the car's centre where its wheels touch the floor
_QUARTER_TURN: Final = math.pi / 2.0


@dataclass(frozen=True)
class WheeledCar:
    """A car on a free joint, which opens the configuration: x, y, z, quaternion.

    Its wheels' axle is the x axis of its body, and positive controls drive it along -y: `heading` is that
    direction. Its lidar counts from the x axis, as the original's does: bin 0 looks to the heading's left.

    Attributes:
        name: Prefix of its assets: ``<name>_goal<level>.xml``.
        body: Name of its root body; every geom in its subtree counts as the robot.
        n_sensors: 15 sensors, then the caster's orientation as a rotation matrix, by rows.
        corners: Corners of its outline in its body's frame, m: chassis with wheels, bumpers.
    """

    name: str
    body: str
    n_sensors: int
    corners: tuple[tuple[float, float], ...]

    @property
    def radius(self) -> float:
        """Largest horizontal distance of any point of the upright car from its centre, m."""
        return max(math.hypot(x, y) for x, y in self.corners)

    def place(self, qpos: Array, pose: Array) -> None:
        """Stand upright on the floor with the driving direction along the pose's heading."""
        x, y, heading = pose.tolist()
        half = (heading + _QUARTER_TURN) / 2.0
        qpos[:7] = x, y, _HEIGHT, math.cos(half), 0.0, 0.0, math.sin(half)

    def heading(self, qpos: Array) -> float:
        """Direction of the body's -y axis seen from above, in [-pi, pi], rad."""
        rotation = _rotation(qpos[3:7])
        return math.atan2(-rotation[1, 1], -rotation[0, 1])

    def sensors(self, data: mujoco.MjData) -> Array:
        """The sensors, and the caster's quaternion as a rotation matrix."""
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


CAR: Final = WheeledCar(
    name="car",
    body="agent",
    n_sensors=24,  # accelerometer, velocimeter, gyro, magnetometer, caster's turning, its 3 x 3 orientation
    # The chassis, the back bumper, the front bumper, the wheels' outer rims.
    corners=((0.1, -0.1), (0.1, 0.16), (0.05, -0.175), (0.155, 0.15), (0.155, 0.05)),
)
"""Safety-Gymnasium's car."""
