"""Imu: an inertial measurement unit on a sensor's body, and the ego-motion that is reckoned from its readings."""

from dataclasses import dataclass

import mujoco
import numpy as np

from safe_wrappers.checks import Array, check_fields, non_negative, positive
from safe_wrappers.control.estimation.dead_reckoning import DeadReckoning
from safe_wrappers.control.estimation.lever_arm import rigid_transform
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.mujoco.model import named
from safe_wrappers.plants.queries.line_of_sight import LineOfSight


@dataclass
class Imu:
    """An accelerometer and a gyroscope at a site of the sensor's body, from which follows where the body is.

    It integrates by itself, as such units do, and reports at the end of each control step.

    Args:
        site: Name of the site; its axes are those of the readings.
        accelerometer_std: Of the noise of a control step's mean acceleration, m/s².
        gyro_std: Of the noise of a control step's mean turn rate, and of that at its end, rad/s.
        fix_every_s: How often the true pose and velocity of the body are given to the reckoning, s; None: at a reset
            alone.
        lever_arm: Whether the reckoning knows where on the body the unit sits; False takes the body's origin.

    Raises:
        ConfigurationError: A number outside its range.
    """

    site: str
    accelerometer_std: float = 0.0
    gyro_std: float = 0.0
    fix_every_s: float | None = None
    lever_arm: bool = True

    def __post_init__(self) -> None:
        if not isinstance(self.site, str):
            raise ConfigurationError(f"site is the name of a site, got {self.site!r}")
        check_fields(self, non_negative, ["accelerometer_std"], "m/s^2")
        check_fields(self, non_negative, ["gyro_std"], "rad/s")
        check_fields(self, positive, ["fix_every_s"], "s")
        if not isinstance(self.lever_arm, bool | np.bool_):
            raise ConfigurationError(f"lever_arm is True or False, got {self.lever_arm!r}")
        self.lever_arm = bool(self.lever_arm)


class EgoMotion:
    """Where a sensor's body is taken to be, by dead reckoning from the readings of its `Imu`.

    Attributes:
        position: Of the body's origin, shape (3,), m.
        velocity: Shape (3,), m/s.
        specific_force: Mean of the accelerometer's readings over the last step, in the axes of its middle, shape
            (3,), m/s².
        rate: The gyroscope's reading at its end, shape (3,), rad/s.

    Raises:
        ConfigurationError: An `Imu` on another body than the sensor.
        UnknownNameError: No site of that name.
    """

    def __init__(self, imu: Imu, sight: LineOfSight) -> None:
        self.imu, self._sight, model = imu, sight, sight.model
        self._site = named(model, "site", imu.site)
        body = int(model.site_bodyid[self._site])
        if body != sight.body:
            where = f"{model.body(body).name!r} and not on {model.body(sight.body).name!r}, as the sensor is"
            raise ConfigurationError(f"the IMU's site {imu.site!r} is on the body {where}")
        axes = np.zeros(9)
        mujoco.mju_quat2Mat(axes, model.site_quat[self._site])
        arm = model.site_pos[self._site] if imu.lever_arm else np.zeros(3)
        self._gravity = np.array(model.opt.gravity)
        self._reckoning = DeadReckoning(rigid_transform(axes.reshape(3, 3), arm), self._gravity)
        self.specific_force = self.rate = np.zeros(3)
        self._since_fix_s = 0.0
        self._at_site = np.zeros(3), np.eye(3)

    @property
    def position(self) -> Array:
        """Of the body's origin, shape (3,), m, world axes."""
        return self._reckoning.position

    @property
    def velocity(self) -> Array:
        """Of the body's origin, shape (3,), m/s, world axes."""
        return self._reckoning.velocity

    @property
    def angular_velocity(self) -> Array:
        """Shape (3,), rad/s, world axes."""
        return self._reckoning.angular_velocity

    @property
    def rotation(self) -> Array:
        """The body's axes as columns, shape (3, 3)."""
        return np.asarray(self._reckoning.orientation.as_matrix())

    def fix(self) -> None:
        """Take the body's true motion, at the state that was read last."""
        sight = self._sight
        self._at_site = self._read()
        linear, _ = sight.velocity(sight.body)
        position = np.array(sight.data.xpos[sight.body])
        body = rigid_transform(np.array(sight.data.xmat[sight.body]).reshape(3, 3), position)
        self._reckoning.fix(position, linear, body.rotation, self.rate)
        self._since_fix_s = 0.0

    def advance(self, time_s: float, noise: Array) -> None:
        """Read what the step to the present state did, and reckon on.

        Args:
            time_s: Length of the step.
            noise: Nine standard normal numbers: of the mean acceleration, the mean turn rate, and that at the end.
        """
        if time_s <= 0.0:
            return
        velocity, axes = self._at_site
        self._at_site = after, new_axes = self._read()
        turned = rigid_transform(axes.T @ new_axes, np.zeros(3)).rotation
        turn = turned.as_rotvec()
        middle = axes @ type(turned).from_rotvec(0.5 * turn).as_matrix()
        force = ((after - velocity) / time_s - self._gravity) @ middle
        self.specific_force = force + self.imu.accelerometer_std * noise[:3]
        turn = turn + self.imu.gyro_std * time_s * noise[3:6]
        self.rate = self.rate + self.imu.gyro_std * noise[6:]
        self._reckoning.advance(self.specific_force, turn, self.rate, time_s)
        self._since_fix_s += time_s
        if self.imu.fix_every_s is not None and self._since_fix_s >= self.imu.fix_every_s - 1e-9:
            self.fix()

    def _read(self) -> tuple[Array, Array]:
        """Velocity of the site (3,), m/s, and its axes (3, 3) in the world; the gyroscope's reading without noise."""
        data, six = self._sight.data, np.zeros(6)
        mujoco.mj_objectVelocity(self._sight.model, data, mujoco.mjtObj.mjOBJ_SITE, self._site, six, 0)
        axes = np.array(data.site_xmat[self._site]).reshape(3, 3)
        self.rate = six[:3] @ axes
        return six[3:], axes
