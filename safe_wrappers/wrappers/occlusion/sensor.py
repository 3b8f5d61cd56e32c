"""Sensor: where an `OcclusionPenalty` looks from, how far, and how well it measures."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import mujoco
import numpy as np

from safe_wrappers.checks import Array, check_fields, non_negative, positive, settings_from
from safe_wrappers.control.estimation.covariance import checked_noise
from safe_wrappers.control.numerics.spatial import from_sensor, lever_arm_velocity, to_sensor
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.queries.line_of_sight import LineOfSight
from safe_wrappers.serialize import plain_numbers
from safe_wrappers.wrappers.occlusion.imu import EgoMotion, Imu


@dataclass
class Sensor:
    """A camera, or any other sensor that needs a line of sight, on a body of the model.

    It measures the tracked point's position (and velocity) relative to itself, in its own axes, with Gaussian noise.

    Args:
        camera: Name of a camera in the model, which looks along its own -z; or
        site: name of a site, which looks along its own z.
        view_deg: Full opening angle of the cone that it sees, degrees. None: a camera's `fovy`, a site's all around.
        range_m: Farther away it sees nothing, m; None: as far as there is.
        occluder_groups: Geom groups (0 to 5) that block its sight; None: all of them.
        position_std: Of a measured position, m: a number for every axis, or a covariance matrix (d x d, m^2) in world
            axes. None: it does not measure positions.
        velocity_std: Likewise of a measured velocity, m/s and m^2/s^2. None: it does not measure velocities.
        dropout: Probability that a measurement of what is in sight is lost, for each track and step, below 1.
        lever_arm: Whether the estimator knows where on its body the sensor sits; False takes the body's origin.
        imu: An `Imu` on the same body, from which the estimator reckons where that body is, or the dict of one; None:
            it knows.

    Raises:
        ConfigurationError: Both or neither of camera and site, nothing measured, or a number outside its range.
    """

    camera: str | None = None
    site: str | None = None
    view_deg: float | None = None
    range_m: float | None = None
    occluder_groups: Sequence[int] | None = None
    position_std: Any = 0.05
    velocity_std: Any = None
    dropout: float = 0.0
    lever_arm: bool = True
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
        check_fields(self, non_negative, ["dropout"], "probability per step")
        if self.dropout >= 1.0:
            raise ConfigurationError(f"dropout is a probability below 1, got {self.dropout}")
        if self.occluder_groups is not None:
            self.occluder_groups = _groups(self.occluder_groups)
        if self.position_std is None and self.velocity_std is None:
            raise ConfigurationError("the sensor measures nothing: give position_std, velocity_std or both")
        if not isinstance(self.lever_arm, bool | np.bool_):
            raise ConfigurationError(f"lever_arm is True or False, got {self.lever_arm!r}")
        self.lever_arm = bool(self.lever_arm)
        if self.imu is not None:
            self.imu = settings_from(Imu, self.imu, "imu")
        for name in ("position_std", "velocity_std"):
            setattr(self, name, plain_numbers(getattr(self, name)))

    def matrices(self, coordinates: int) -> tuple[Array, Array]:
        """C (m, 2d) and the noise covariance R (m, m) for states (position, velocity) of d coordinates."""
        state = np.eye(2 * coordinates)
        parts = {"position_std": state[:coordinates], "velocity_std": state[coordinates:]}
        measured = {name: part for name, part in parts.items() if getattr(self, name) is not None}
        noise = np.zeros((coordinates * len(measured),) * 2)
        for i, name in enumerate(measured):
            block = slice(i * coordinates, (i + 1) * coordinates)
            noise[block, block] = _noise(name, getattr(self, name), coordinates)
        return np.concatenate(list(measured.values())), noise

    def measured(
        self, sight: LineOfSight, d: int, truth: Array, velocities: Array | None, ego: EgoMotion | None = None
    ) -> Array:
        """Positions (k, 3), m, and velocities (k, d), m/s, as they are measured, noise aside, shape (k, m).

        Where the sensor's body is taken to be is the ego-motion's, if there is one, else the model's.
        """
        body = np.array(sight.data.xpos[sight.body])
        eye, axes = sight.position, sight.rotation
        if ego is None:
            turned, believed = np.eye(3), eye if self.lever_arm else body
        else:
            # From the world's axes to where the body's believed orientation puts what is seen along them.
            turned = ego.rotation @ np.array(sight.data.xmat[sight.body]).reshape(3, 3).T
            believed = ego.position + (turned @ (eye - body) if self.lever_arm else 0.0)
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

    def data(self) -> dict[str, Any]:
        """Plain data, from which it can be made again."""
        return asdict(self)


def _groups(given: Any) -> list[int]:
    groups = list(given) if isinstance(given, Sequence | np.ndarray) else []
    if not groups or not all(isinstance(g, int | np.integer) and 0 <= g < mujoco.mjNGROUP for g in groups):
        wanted = f"a list of geom groups, 0 to {mujoco.mjNGROUP - 1}, or None for all"
        raise ConfigurationError(f"occluder_groups is {wanted}; got {given!r}")
    return [int(g) for g in groups]


def _noise(name: str, given: Any, coordinates: int) -> Array:
    if not isinstance(given, list):
        return positive(name, given, "m or m/s") ** 2 * np.eye(coordinates)
    return checked_noise(f"{name} as a covariance", given, coordinates)


def sensor_from(given: Any) -> Sensor:
    """A sensor itself, the name of a camera, or the dict of a recorded one."""
    if isinstance(given, str):
        return Sensor(camera=given)
    if isinstance(given, Sensor | dict):
        return settings_from(Sensor, given, "a sensor")
    raise ConfigurationError(f"sensor is a Sensor(...), or the name of a camera of the model; got {given!r}")
