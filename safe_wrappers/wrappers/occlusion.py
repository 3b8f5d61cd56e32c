"""OcclusionPenalty: what is not seen is estimated, and not to see costs reward; with its sensors and tracks."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Any, ClassVar

import gymnasium as gym
import mujoco
import numpy as np

from safe_wrappers import info as keys
from safe_wrappers.control.dead_reckoning import DeadReckoning, lever_arm_velocity, rigid_transform
from safe_wrappers.control.estimation import Motion, Tracks, largest_deviation, unobservable_states
from safe_wrappers.errors import (
    Array,
    ConfigurationError,
    SafeWrappersError,
    UnknownNameError,
    check_fields,
    finite_array,
    non_negative,
    positive,
    settings_from,
)
from safe_wrappers.plants.env_checks import read_attribute
from safe_wrappers.plants.mujoco.binding import physics_steps
from safe_wrappers.plants.mujoco.line_of_sight import LineOfSight
from safe_wrappers.plants.mujoco.model import named
from safe_wrappers.wrappers.layer import Env, LayerWrapper, Step, WrapperRng, mujoco_env
from safe_wrappers.wrappers.stack import Layer

__all__ = ["Imu", "Sensor", "Track"]


@dataclass
class Imu:
    """An accelerometer and a gyroscope at a site of the sensor's body, from which follows where the body is.

    Args:
        site: Name of the site; its axes are those of the readings.
        accelerometer_std: Of the noise of a control step's mean acceleration, m/s².
        gyro_std: Of the noise of a control step's mean turn rate, and of that at its end, rad/s.
        fix_every_s: How often the reckoning gets the body's true pose and velocity, s; None: at a reset alone.

    Raises:
        ConfigurationError: A number outside its range.
    """

    site: str
    accelerometer_std: float = 0.0
    gyro_std: float = 0.0
    fix_every_s: float | None = None

    def __post_init__(self) -> None:
        check_fields(self, non_negative, ["accelerometer_std"], "m/s^2")
        check_fields(self, non_negative, ["gyro_std"], "rad/s")
        check_fields(self, positive, ["fix_every_s"], "s")


class EgoMotion(DeadReckoning):
    """Where a sensor's body is taken to be, by dead reckoning from the readings of its `Imu`.

    Attributes:
        specific_force: Mean reading over the last step, in the axes of its middle, shape (3,), m/s².
        rate: The gyroscope's reading at its end, shape (3,), rad/s.
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
        """Read what the step to the present state, of `time_s`, did; with nine standard normal numbers as noise."""
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

    It measures positions (and velocities) relative to itself, in its own axes, with Gaussian noise.

    Args:
        camera: Name of a camera in the model, which looks along its own -z; or
        site: name of a site, which looks along its own z.
        view_deg: Full opening angle of the cone that it sees, degrees. None: a camera's `fovy`, a site's all around.
        range_m: Range of sight, m; None: no end.
        position_std: Of a measured position along each axis, m. None: it does not measure positions.
        velocity_std: Of a measured velocity along each axis, m/s. None: it does not measure velocities.
        imu: An `Imu` on the same body, or the dict of one, by which it reckons where that body is; None: it knows.

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
        units = {"view_deg": "degrees", "range_m": "m", "position_std": "m", "velocity_std": "m/s"}
        for name, unit in units.items():
            if (value := getattr(self, name)) is not None:
                setattr(self, name, positive(name, value, unit))
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
            turned = ego.orientation.as_matrix() @ np.array(sight.data.xmat[sight.body]).reshape(3, 3).T
            believed = ego.position + turned @ (eye - body)
        parts = []
        if self.position_std is not None:
            seen = (truth - eye) @ axes  # in the sensor's frame
            parts.append((seen @ (turned @ axes).T + believed)[:, :d])
        if velocities is not None:
            linear, angular = sight.velocity(sight.body)
            apparent = velocities - lever_arm_velocity(linear, angular, eye - body)[:d]
            own = (
                (linear, angular, body) if ego is None else (ego.velocity, ego.angular_velocity, ego.position)
            )
            own_velocity = lever_arm_velocity(own[0], own[1], believed - own[2])[:d]
            parts.append(apparent @ turned[:d, :d].T + own_velocity)
        return np.concatenate(parts, axis=1)


@dataclass
class Track:
    """What an `OcclusionPenalty` follows: bodies of the model, or points that the env publishes, and how they move.

    At a reset the track starts from the true position plus noise of `start_position_std`, and from the mean velocity.

    Args:
        bodies: Name of a body, or a pattern ("car*", "car[012]") for every body that fits, in the model's order.
        published: Instead of bodies: name of an attribute of the env, positions of shape (k, 2) or (k, 3), m.
        acceleration_noise: Intensity q of the white acceleration noise, m^2/s^3, a number or one per coordinate:
            after t seconds unseen it adds q t^3 / 3 to the variance of a position. It has no default.
        reversion_s: Time constant with which the velocity goes back to `mean_velocity`, s; None: it does not.
        mean_velocity: m/s, one per coordinate; None: zeros.
        start_position_std: m, a number or one per coordinate.
        start_velocity_std: m/s, a number or one per coordinate.

    Raises:
        ConfigurationError: Bodies and published points at once, or neither; a number out of its range.
    """

    bodies: str | None = None
    published: str | None = None
    acceleration_noise: Any = field(kw_only=True)
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
        check_fields(self, positive, ["reversion_s"], "s")

    def motion(self, coordinates: int) -> Motion:
        """The motion model for d coordinates."""
        mean = 0.0 if self.mean_velocity is None else self.mean_velocity
        reversion_s = np.inf if self.reversion_s is None else self.reversion_s
        noise = _each("acceleration_noise", self.acceleration_noise, coordinates)
        return Motion(np.diag(noise), reversion_s, _each("mean_velocity", mean, coordinates, least=-np.inf))

    def start(self, coordinates: int) -> Array:
        """Standard deviations of position and velocity at a reset, shape (2d,)."""
        names = "start_position_std", "start_velocity_std"
        return np.concatenate([_each(name, getattr(self, name), coordinates) for name in names])


def _each(name: str, given: Any, coordinates: int, least: float = 0.0) -> Array:
    """One finite number per coordinate, shape (coordinates,)."""
    values = finite_array(name, given)
    if values.shape not in ((), (1,), (coordinates,)) or (values < least).any():
        wanted = f"a number, or {coordinates} numbers (one per coordinate)"
        raise ConfigurationError(f"{name} is {wanted}, of at least {least:g}; got {given!r}")
    return np.array(np.broadcast_to(values, coordinates))


class OcclusionPenalty(LayerWrapper):
    """Estimates what a sensor on the robot sees, and sees no more, and takes a penalty off the reward for not seeing.

    After every step it casts a ray to each tracked point. What is in sight is measured, with noise, and updates the
    track's Kalman estimate; what is not grows less certain, as the Lyapunov equation says. Permission to rely on a
    track expires before ``sigmas * sigma`` crosses `tolerance`, one control step ahead. The filter belongs outside:
    its `TrackPermission` and `TrackedDiscs` read the estimates. If things move and the sensor errs as declared, the
    errors have the covariances that are given; these are no hard bounds, and say nothing of what is not tracked.

    Args:
        env: Its unwrapped env has MuJoCo's `.model` and `.data`.
        tracks: Each a `Track`, or the dict of a recorded one.
        sensor: A `Sensor`, or the name of a camera in the model.
        tolerance: Position error that the task can bear, m.
        weight: Of the penalty, the mean of ``min(1, sigmas * sigma / tolerance) ** 2`` over the tracks within the
            sensor's range; the task's reward per step.
        sigmas: k of the bound that is compared with the tolerance.
        axes: "xy" tracks in the plane, "xyz" in space.
        observe: Whether the observation (other than a flat Box under "tracks") gains each track's estimated position
            from the sensor's body (m, world axes), velocity (m/s) and deviation along each axis (m).

    Info, at every step and at reset: ``occlusion/visible``, ``occlusion/expired`` (bool arrays, one per track),
    ``occlusion/sigma`` (m, array), ``occlusion/penalty`` (float).

    Attributes:
        tracking: The `control.estimation.Tracks`: positions, velocities, covariances, and those ahead.
        track_names: One per track: the body's name, or the attribute's with an index.
        ego_motion: Where the sensor's body is taken to be (`position`, m, `velocity`, m/s) by its `Imu`, or None.
        last_seen_positions: Where each was measured to be last, shape (n, d), m; before that, the initial fix.
        permitted: Tracks that may be relied on, bool (n,).

    Raises:
        UnsupportedEnvError: No MuJoCo model.
        ConfigurationError: A number outside its range, a name that the model does not have, an `Imu` on another body.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> env = gym.make("OccludedCrossing-v0")
        >>> cars = [sw.occlusion.Track("car*", acceleration_noise=[0.03, 0], start_position_std=[0.3, 0])]
        >>> env = sw.OcclusionPenalty(env, cars, "eye", tolerance=1.0, weight=0.05)
        >>> _ = env.reset(seed=0)
        >>> info = env.step(env.action_space.sample())[4]
        >>> info["occlusion/visible"].shape
        (6,)

    Source: appendix "Continuous Covariance Propagation and Observability".
    """

    layer: ClassVar = Layer.OCCLUSION

    def __init__(
        self,
        env: Env,
        tracks: Sequence[Track | dict[str, Any]],
        sensor: Sensor | str | dict[str, Any],
        tolerance: float,
        weight: float = 0.0,
        sigmas: float = 3.0,
        axes: str = "xy",
        observe: bool = True,
    ) -> None:
        LayerWrapper.__init__(self, env)
        raw = mujoco_env(env, "OcclusionPenalty")
        if isinstance(tracks, str | dict) or not isinstance(tracks, Sequence) or not tracks:
            raise ConfigurationError(f"tracks is a list with at least one Track, got {tracks!r}")
        self.tracks = [settings_from(Track, track, "a track") for track in tracks]
        named_camera = Sensor(camera=sensor) if isinstance(sensor, str) else sensor
        self.sensor = settings_from(Sensor, named_camera, "sensor", ", or the name of a camera")
        if self.sensor.velocity_std is not None and any(t.published is not None for t in self.tracks):
            raise ConfigurationError("velocity_std: velocities are measured of bodies alone")
        self.tolerance = positive("tolerance", tolerance, "m")
        self.weight = non_negative("weight", weight, "the task's reward per step")
        self.sigmas = positive("sigmas", sigmas, "standard deviations")
        if axes not in ("xy", "xyz"):
            raise ConfigurationError(f"axes is 'xy' or 'xyz', got {axes!r}")
        self.observe = observe
        self._raw, self._d, self._random = raw, len(axes), WrapperRng("OcclusionPenalty")
        self._control_dt = physics_steps(raw) * float(raw.model.opt.timestep)
        self._matrix, self._noise = self.sensor.matrices(self._d)
        self._noise_root = np.linalg.cholesky(self._noise)
        self.track_names = self._look_at(raw.model)
        self.tracking = Tracks([track.motion(self._d) for track in self._owners])
        self._start_std = np.stack([track.start(self._d) for track in self._owners])
        self._state_names = [*axes, *(f"v{axis}" for axis in axes)]
        self.last_seen_positions = np.zeros((len(self.track_names), self._d))
        self.permitted = np.zeros(len(self.track_names), dtype=bool)
        if self.observe:
            size = 3 * self._d * len(self.track_names)
            self._widen_observation("tracks", gym.spaces.Box(-np.inf, np.inf, (size,), np.float64))

    def _look_at(self, model: mujoco.MjModel) -> list[str]:
        """Resolve names on a model; the names of all that the tracks follow, in their order."""
        s = self.sensor
        range_m = math.inf if s.range_m is None else s.range_m
        self._sight = LineOfSight(model, s.camera, s.site, s.view_deg, range_m)
        self.ego_motion = EgoMotion(s.imu, self._sight) if isinstance(s.imu, Imu) else None
        found = [(name, body, track) for track in self.tracks for name, body in self._followed(track, model)]
        self._bodies = np.array([body for _, body, _ in found], dtype=np.intp)
        self._owners = [track for *_, track in found]
        return [name for name, *_ in found]

    def _followed(self, track: Track, model: mujoco.MjModel) -> list[tuple[str, int]]:
        """Names and ids of a track's bodies, or of its points, whose ids are -1."""
        if track.bodies is None:
            return [(f"{track.published}[{i}]", -1) for i in range(len(self._published(track)))]
        there = {model.body(b).name: b for b in range(1, model.nbody) if model.body(b).name}
        found = [(name, b) for name, b in there.items() if fnmatchcase(name, track.bodies)]
        if not found:
            known = ", ".join(there) or "none"
            raise UnknownNameError(f"the model has no body {track.bodies!r}; it has: {known}")
        return found

    def _published(self, track: Track) -> Array:
        points = np.asarray(read_attribute(self.env, track.published or ""), dtype=np.float64)
        if points.ndim != 2 or points.shape[1] not in (self._d, 3) or not len(points):
            wanted = f"positions of shape (k, {self._d}) or (k, 3), k >= 1"
            raise ConfigurationError(f"the env's {track.published} must be {wanted}, got {points.shape}")
        return points

    def _truth(self) -> tuple[Array, Array | None]:
        """True positions, shape (n, 3), m, and velocities, (n, d), m/s, if the sensor measures them."""
        sight = self._sight
        positions = np.array(sight.data.xpos[self._bodies])
        velocities = None
        if self.sensor.velocity_std is not None:  # then all of them are bodies
            velocities = np.stack([sight.velocity(int(body))[0][: self._d] for body in self._bodies])
        for track in self.tracks:
            if track.published is not None:
                points = self._published(track)
                which = [i for i, owner in enumerate(self._owners) if owner is track]
                if len(points) != len(which):
                    counts = f"had {len(which)} points when the wrapper was made, and has {len(points)} now"
                    raise ConfigurationError(f"the env's {track.published} {counts}")
                positions[which, 2] = sight.position[2]  # a point of the plane is looked at level
                positions[which, : points.shape[1]] = points
        return positions, velocities

    def _begin(self, observation: Any, info: dict[str, Any], seed: int | None) -> Any:
        """Start every track from its initial fix, and look once."""
        self._random.reset(self.env, seed)
        if self._sight.model is not self._raw.model:
            names = self._look_at(self._raw.model)
            if names != self.track_names:
                tracked = f"{', '.join(names)} and not {', '.join(self.track_names)}"
                raise ConfigurationError(f"the env has another model, with other things: {tracked}")
        self._time = float(self._raw.data.time)
        self._sight.read(self._raw.data)
        if self.ego_motion is not None:
            self.ego_motion.fix_now()
        d, n = self._d, len(self.track_names)
        truth, _ = self._truth()
        mean = np.zeros((n, self.tracking.size))
        mean[:, :d] = truth[:, :d] + self._start_std[:, :d] * self._random.draw.standard_normal((n, d))
        mean[:, d:] = np.stack([motion.mean_velocity for motion in self.tracking.motions])
        self.tracking.start(mean, self._start_std[:, :, None] ** 2 * np.eye(self.tracking.size))
        self.last_seen_positions = mean[:, :d].copy()
        info.update(self._look())
        info[keys.OCCLUSION_PENALTY] = 0.0
        return self._observed(observation)

    def step(self, action: Any) -> Step:
        """Step the env with the action as it is, and look."""
        observation, reward, terminated, truncated, info = self._pass_on(action)
        before, self._time = self._time, float(self._raw.data.time)
        elapsed = self._time - before
        if abs(elapsed - self._control_dt) < 1e-9:
            elapsed = self._control_dt
        if elapsed < 0.0:
            gone = f"backwards by {-elapsed:g} s within a step"
            raise SafeWrappersError(f"the simulation's time ran {gone}. Reset the env instead")
        self.tracking.advance(elapsed)
        self._sight.read(self._raw.data)
        if self.ego_motion is not None:
            self.ego_motion.read(elapsed, self._random.draw.standard_normal(9))
        info.update(self._look())
        penalty = self.weight * self._uncertainty() if self.weight else 0.0
        info[keys.OCCLUSION_PENALTY] = penalty
        if penalty:
            reward = float(reward) - penalty
        return self._observed(observation), reward, terminated, truncated, info

    @property
    def unobservable(self) -> dict[str, list[str]]:
        """Track name -> its states ("x", "vy") that the sensor does not determine in sight."""
        return {
            name: list(unobservable_states(motion.matrices()[0], self._matrix, self._state_names))
            for name, motion in zip(self.track_names, self.tracking.motions, strict=True)
        }

    def _look(self) -> dict[str, Any]:
        """Measure what is in sight, and report what may be relied on."""
        d, n = self._d, len(self.track_names)
        truth, velocities = self._truth()
        seen = self._sight.sees(truth, self._bodies)
        # Drawn for every track, seen or not, so that the noise of one does not depend on another's sight.
        noise = self._random.draw.standard_normal((n, self._noise.shape[0])) @ self._noise_root.T
        which = np.flatnonzero(seen)
        if which.size:
            among = None if velocities is None else velocities[which]
            measurements = self.sensor.measured(self._sight, d, truth[which], among, self.ego_motion)
            measurements += noise[which]
            self.tracking.see(which, measurements, self._matrix, self._noise)
            if self.sensor.position_std is not None:
                self.last_seen_positions[which] = measurements[:, :d]
        self._sigma = largest_deviation(self.tracking.position_covariances)
        soon = largest_deviation(self.tracking.ahead([self._control_dt])[1][0])
        self.permitted = self.sigmas * np.maximum(self._sigma, soon) <= self.tolerance
        return {
            keys.OCCLUSION_VISIBLE: seen,
            keys.OCCLUSION_SIGMA: self._sigma.copy(),
            keys.OCCLUSION_EXPIRED: ~self.permitted,
        }

    def _uncertainty(self) -> float:
        """Mean share of the tolerated variance that is used up, over the tracks within range."""
        share = np.minimum(1.0, self.sigmas * self._sigma / self.tolerance) ** 2
        if self.sensor.range_m is None:
            return float(share.mean())
        away = self.tracking.positions - self._sight.position[: self._d]
        near = (away * away).sum(axis=1) <= self.sensor.range_m**2
        return float(share[near].mean()) if near.any() else 0.0

    def _observed(self, observation: Any) -> Any:
        if not self.observe:
            return observation
        ego = self.ego_motion
        body = (self._sight.data.xpos[self._sight.body] if ego is None else ego.position)[: self._d]
        tracking = self.tracking
        deviations = np.sqrt(np.diagonal(tracking.position_covariances, axis1=1, axis2=2))
        flat = np.concatenate([tracking.positions - body, tracking.velocities, deviations], axis=1).ravel()
        return self._with_numbers(observation, "tracks", flat)
