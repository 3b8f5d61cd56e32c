"""What an `OcclusionPenalty` is made of: sensors, inertial units and tracks."""

from collections.abc import Callable, Sequence, Sized
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

import mujoco
import numpy as np

from safe_wrappers.checks import Array, check_fields, non_negative, positive, settings_from
from safe_wrappers.control.dead_reckoning import (
    DeadReckoning,
    from_sensor,
    lever_arm_velocity,
    rigid_transform,
    to_sensor,
)
from safe_wrappers.control.estimation import Motion
from safe_wrappers.errors import ConfigurationError, UnknownNameError
from safe_wrappers.plants.mujoco.line_of_sight import LineOfSight
from safe_wrappers.plants.mujoco.model import named
from safe_wrappers.serialize import plain_numbers

__all__ = ["Imu", "Sensor", "Track"]


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

    Raises:
        ConfigurationError: A number outside its range.
    """

    site: str
    accelerometer_std: float = 0.0
    gyro_std: float = 0.0
    fix_every_s: float | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.site, str):
            raise ConfigurationError(f"site is the name of a site, got {self.site!r}")
        check_fields(self, non_negative, ["accelerometer_std"], "m/s^2")
        check_fields(self, non_negative, ["gyro_std"], "rad/s")
        check_fields(self, positive, ["fix_every_s"], "s")


class EgoMotion(DeadReckoning):
    """Where a sensor's body is taken to be, by dead reckoning from the readings of its `Imu`.

    Attributes:
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
        super().__init__(rigid_transform(axes.reshape(3, 3), model.site_pos[self._site]), model.opt.gravity)
        self.specific_force = self.rate = np.zeros(3)
        self._since_fix_s = 0.0
        self._at_site = np.zeros(3), np.eye(3)

    @property
    def rotation(self) -> Array:
        """The body's axes as columns, shape (3, 3)."""
        return np.asarray(self.orientation.as_matrix())

    def fix_now(self) -> None:
        """Take the body's true motion, at the state that was read last."""
        sight = self._sight
        self._at_site = self._read()
        linear, _ = sight.velocity(sight.body)
        position = np.array(sight.data.xpos[sight.body])
        body = rigid_transform(np.array(sight.data.xmat[sight.body]).reshape(3, 3), position)
        self.fix(position, linear, body.rotation, self.rate)
        self._since_fix_s = 0.0

    def read(self, time_s: float, noise: Array) -> None:
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
        force = ((after - velocity) / time_s - self.gravity) @ middle
        self.specific_force = force + self.imu.accelerometer_std * noise[:3]
        turn = turn + self.imu.gyro_std * time_s * noise[3:6]
        self.rate = self.rate + self.imu.gyro_std * noise[6:]
        self.advance(self.specific_force, turn, self.rate, time_s)
        self._since_fix_s += time_s
        if self.imu.fix_every_s is not None and self._since_fix_s >= self.imu.fix_every_s - 1e-9:
            self.fix_now()

    def _read(self) -> tuple[Array, Array]:
        """Velocity of the site (3,), m/s, and its axes (3, 3) in the world; the gyroscope's reading without noise."""
        data, six = self._sight.data, np.zeros(6)
        mujoco.mj_objectVelocity(self._sight.model, data, mujoco.mjtObj.mjOBJ_SITE, self._site, six, 0)
        axes = np.array(data.site_xmat[self._site]).reshape(3, 3)
        self.rate = six[:3] @ axes
        return six[3:], axes


@dataclass
class Sensor:
    """A camera, or any other sensor that needs a line of sight, on a body of the model.

    It measures the tracked point's position (and velocity) relative to itself, in its own axes, with Gaussian noise.

    Args:
        camera: Name of a camera in the model, which looks along its own -z; or
        site: name of a site, which looks along its own z.
        view_deg: Full opening angle of the cone that it sees, degrees. None: a camera's `fovy`, a site's all around.
        range_m: Farther away it sees nothing, m; None: as far as there is.
        position_std: Of a measured position along each axis, m. None: it does not measure positions.
        velocity_std: Of a measured velocity along each axis, m/s. None: it does not measure velocities.
        imu: An `Imu` on the same body, from which the estimator reckons where that body is, or the dict of one; None:
            it knows.

    Raises:
        ConfigurationError: Both or neither of camera and site, nothing measured, or a number outside its range.
    """

    camera: str | None = None
    site: str | None = None
    view_deg: float | None = None
    range_m: float | None = None
    position_std: float | None = 0.05
    velocity_std: float | None = None
    imu: Imu | dict[str, Any] | None = None

    def __post_init__(self) -> None:
        if (self.camera is None) == (self.site is None):
            given = f"camera={self.camera!r}, site={self.site!r}"
            raise ConfigurationError(f"a sensor sits at a camera or at a site: name one of them; got {given}")
        for name in ("camera", "site"):
            if not isinstance(getattr(self, name), str | None):
                raise ConfigurationError(f"{name} is a name, got {getattr(self, name)!r}")
        check_fields(self, positive, ["view_deg"], "degrees")
        check_fields(self, positive, ["range_m"], "m")
        if self.position_std is not None:
            self.position_std = positive("position_std", self.position_std, "m")
        check_fields(self, positive, ["velocity_std"], "m/s")
        if self.position_std is None and self.velocity_std is None:
            raise ConfigurationError("the sensor measures nothing: give position_std, velocity_std or both")
        if self.imu is not None:
            self.imu = settings_from(Imu, self.imu, "imu")

    def matrices(self, coordinates: int) -> tuple[Array, Array]:
        """C (m, 2d) and the noise covariance R (m, m) for states (position, velocity) of d coordinates."""
        stds = np.repeat(np.array([self.position_std, self.velocity_std], dtype=np.float64), coordinates)
        measured = ~np.isnan(stds)  # None is not a number
        return np.eye(2 * coordinates)[measured], np.diag(stds[measured] ** 2)

    def measured(
        self, sight: LineOfSight, d: int, truth: Array, velocities: Array | None, ego: EgoMotion | None = None
    ) -> Array:
        """Positions (k, 3), m, and velocities (k, d), m/s, as they are measured, noise aside, shape (k, m).

        Where the sensor's body is taken to be is the ego-motion's, if there is one, else the model's.
        """
        body = np.array(sight.data.xpos[sight.body])
        eye, axes = sight.position, sight.rotation
        if ego is None:
            turned, believed = np.eye(3), eye
        else:
            # From the world's axes to where the body's believed orientation puts what is seen along them.
            turned = ego.rotation @ np.array(sight.data.xmat[sight.body]).reshape(3, 3).T
            believed = ego.position + turned @ (eye - body)
        parts = []
        if self.position_std is not None:
            parts.append(from_sensor(to_sensor(truth, axes, eye), turned @ axes, believed)[:, :d])
        if velocities is not None:
            linear, angular = sight.velocity(sight.body)
            apparent = velocities - lever_arm_velocity(linear, angular, eye - body)[:d]
            own = (
                (linear, angular, body) if ego is None else (ego.velocity, ego.angular_velocity, ego.position)
            )
            own_velocity = lever_arm_velocity(own[0], own[1], believed - own[2])[:d]
            parts.append(apparent @ turned[:d, :d].T + own_velocity)
        return np.concatenate(parts, axis=1)


def sensor_from(given: Any) -> Sensor:
    """A sensor itself, the name of a camera, or the dict of a recorded one."""
    if isinstance(given, str):
        return Sensor(camera=given)
    return settings_from(Sensor, given, "sensor", ", or the name of a camera")


@dataclass
class Track:
    """What an `OcclusionPenalty` follows: bodies of the model, or points that the env publishes, and how they move.

    At a reset the track starts from the true position plus noise of `start_position_std`, and from the mean velocity.

    Args:
        bodies: Name of a body, or a pattern ("car*", "car[012]") for every body that fits, in the model's order.
        published: Instead of bodies: name of an attribute of the env, positions of shape (k, 2) or (k, 3), m.
        acceleration_noise: Intensity q of the white acceleration noise, m^2/s^3: after t seconds unseen it adds
            q t^3 / 3 to the variance of a position. A number, or one per coordinate (0 along a coordinate that does
            not wander). It has no default.
        reversion_s: Time constant with which the velocity goes back to `mean_velocity`, s; None: it does not.
        mean_velocity: m/s, one per coordinate; None: zeros.
        start_position_std: m, a number or one per coordinate.
        start_velocity_std: m/s, a number or one per coordinate.

    Raises:
        ConfigurationError: Bodies and published points at once, or neither; a number out of its range.
    """

    bodies: str | None = None
    published: str | None = None
    acceleration_noise: Any = None
    reversion_s: float | None = None
    mean_velocity: Sequence[float] | None = None
    start_position_std: Any = 0.1
    start_velocity_std: Any = 0.5

    def __post_init__(self) -> None:
        if (self.bodies is None) == (self.published is None):
            given = f"bodies={self.bodies!r}, published={self.published!r}"
            raise ConfigurationError(
                f"a track follows bodies by name or pattern, or published points; got {given}"
            )
        name = self.published if self.bodies is None else self.bodies
        if not isinstance(name, str):
            raise ConfigurationError(f"bodies and published are names, got {name!r}")
        if self.acceleration_noise is None:
            noise = "the intensity of its white acceleration noise in m^2/s^3"
            raise ConfigurationError(f"acceleration_noise is missing: {noise} (0: velocity stays)")
        check_fields(self, positive, ["reversion_s"], "s")
        for name in ("acceleration_noise", "mean_velocity", "start_position_std", "start_velocity_std"):
            setattr(self, name, plain_numbers(getattr(self, name)))

    def motion(self, coordinates: int) -> Motion:
        """The motion model for d coordinates."""
        mean = 0.0 if self.mean_velocity is None else self.mean_velocity
        velocity = _each("mean_velocity", mean, coordinates, "m/s", signed=True)
        reversion_s = np.inf if self.reversion_s is None else self.reversion_s
        noise = np.diag(_each("acceleration_noise", self.acceleration_noise, coordinates, "m^2/s^3"))
        return Motion(noise, reversion_s, velocity)

    def start(self, coordinates: int) -> Array:
        """Standard deviations of position and velocity at a reset, shape (2d,)."""
        position = _each("start_position_std", self.start_position_std, coordinates, "m")
        return np.concatenate(
            [position, _each("start_velocity_std", self.start_velocity_std, coordinates, "m/s")]
        )


def _each(name: str, given: Any, coordinates: int, unit: str, signed: bool = False) -> Array:
    """One number per coordinate."""
    try:
        values = np.asarray(given, dtype=np.float64)
        values = np.array(np.broadcast_to(values, coordinates))
    except (TypeError, ValueError):
        wanted = f"a number or {coordinates} numbers (one per coordinate) in {unit}"
        raise ConfigurationError(f"{name} is {wanted}, got {given!r}") from None
    if not np.isfinite(values).all():
        raise ConfigurationError(f"{name} must be finite, in {unit}, got {given!r}")
    for value in () if signed else values:
        non_negative(name, value, unit)
    return values


class Tracked(NamedTuple):
    """One thing that is tracked."""

    track: Track  # which it belongs to
    name: str  # the body's, or the attribute's with an index
    body: int  # in the model; -1 for a published point


def tracked_things(
    model: mujoco.MjModel, tracks: Sequence[Track], published: Callable[[Track], Sized]
) -> list[Tracked]:
    """All that the tracks follow, in their order."""
    things: list[Tracked] = []
    there = {model.body(b).name: b for b in range(1, model.nbody) if model.body(b).name}
    for track in tracks:
        if track.bodies is None:
            things += [Tracked(track, f"{track.published}[{i}]", -1) for i in range(len(published(track)))]
            continue
        found = [Tracked(track, name, b) for name, b in there.items() if fnmatchcase(name, track.bodies)]
        if not found:
            known = ", ".join(there) or "none"
            raise UnknownNameError(f"the model has no body {track.bodies!r}; it has: {known}")
        things += found
    names = [thing.name for thing in things]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ConfigurationError(f"each thing is tracked once; these are named twice: {', '.join(twice)}")
    return things
