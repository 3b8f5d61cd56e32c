"""OcclusionPenalty: what is not seen is estimated, and not to see costs reward."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium as gym
import mujoco
import numpy as np

from safe_wrappers import info as keys
from safe_wrappers.checks import Array, non_negative, positive, settings_from, true_or_false
from safe_wrappers.control.estimation import Tracks, largest_deviation, unobservable_directions
from safe_wrappers.errors import ConfigurationError, SafeWrappersError, UnsupportedEnvError
from safe_wrappers.plants.env_checks import read_attribute
from safe_wrappers.plants.mujoco.binding import physics_steps
from safe_wrappers.plants.mujoco.line_of_sight import LineOfSight
from safe_wrappers.serialize import plain_data
from safe_wrappers.stack import Layer
from safe_wrappers.wrappers.layer import Env, LayerWrapper, Reset, Step, WrapperRng
from safe_wrappers.wrappers.occlusion import (
    EgoMotion,
    Imu,
    Sensor,
    Track,
    sensor_from,
    tracked_things,
)


class OcclusionPenalty(LayerWrapper):
    """Estimates what a sensor on the robot sees, and sees no more, and takes a penalty off the reward for not seeing.

    After every step it casts a ray to each tracked point. What is in sight is measured, with noise, and updates the
    track's Kalman estimate; what is not grows less certain, as the Lyapunov equation says. A track's permission to be
    relied on expires before ``sigmas * sigma`` crosses `tolerance`, one control step ahead. The filter belongs
    outside: its `TrackPermission` and `TrackedDiscs` read the estimates.

    **What it guarantees.** If things move and the sensor errs as declared, the errors have the covariances that are
    given. **What it does not.** A covariance is no hard bound, and says nothing of things that are not tracked.

    Args:
        env: Its unwrapped env has MuJoCo's `.model` and `.data`.
        tracks: Each a `Track`, or the dict of a recorded one.
        sensor: A `Sensor`, or the name of a camera in the model.
        tolerance: Position error that the task can bear, m.
        weight: Of the penalty, the mean of ``min(1, sigmas * sigma / tolerance) ** 2`` over the tracks within the
            sensor's range; in units of the task's reward per step.
        sigmas: k of the bound that is compared with the tolerance.
        axes: "xy" tracks in the plane, "xyz" in space.
        observe: Whether the observation (other than a flat Box under "tracks") gains, for each track, the estimated
            position from the sensor's body (m, world axes), velocity (m/s) and deviation along each axis (m).

    Info, at every step and at reset: ``occlusion/visible``, ``occlusion/expired`` (bool arrays, one per track),
    ``occlusion/sigma`` (m, array), ``occlusion/penalty`` (float).

    Attributes:
        tracking: The `control.estimation.Tracks`: positions, velocities, covariances, and those ahead.
        track_names: One per track: the body's name, or the attribute's with an index.
        ego_motion: Where the sensor's body is taken to be (`position`, m, and `velocity`, m/s), if the sensor has an
            `Imu`; else None.
        last_seen_positions: Where each was measured to be last, shape (n, d), m; before that, the initial fix.
        permitted: Tracks that may be relied on, bool (n,).
        unobservable: Track name -> directions of its state that the sensor cannot resolve even in sight.

    Raises:
        UnsupportedEnvError: No MuJoCo model.
        ConfigurationError: A number outside its range, a name that the model does not have, or a wrong order.

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
        arguments = dict(locals())
        LayerWrapper.__init__(self, env)
        raw: Any = env.unwrapped
        if not isinstance(getattr(raw, "model", None), mujoco.MjModel) or not hasattr(raw, "data"):
            raise UnsupportedEnvError(f"OcclusionPenalty needs MuJoCo's .model and .data; {raw} has none")
        if isinstance(tracks, str | dict) or not isinstance(tracks, Sequence) or not tracks:
            raise ConfigurationError(f"tracks is a list with at least one Track, got {tracks!r}")
        self.tracks = [settings_from(Track, track, "a track") for track in tracks]
        self.sensor = sensor_from(sensor)
        if self.sensor.velocity_std is not None and any(t.published is not None for t in self.tracks):
            raise ConfigurationError("velocity_std: velocities are measured of bodies alone")
        self.tolerance = positive("tolerance", tolerance, "m")
        self.weight = non_negative("weight", weight, "the task's reward per step")
        self.sigmas = positive("sigmas", sigmas, "standard deviations")
        if axes not in ("xy", "xyz"):
            raise ConfigurationError(f"axes is 'xy' or 'xyz', got {axes!r}")
        self.observe = true_or_false("observe", observe)
        plain = {name: getattr(self, name) for name in ("tolerance", "weight", "sigmas")}
        parts = {"tracks": plain_data(self.tracks), "sensor": plain_data(self.sensor)}
        self._record(arguments, **parts, **plain, observe=self.observe)
        self._raw, self._d, self._random = raw, len(axes), WrapperRng("OcclusionPenalty")
        self._control_dt = physics_steps(raw) * float(raw.model.opt.timestep)
        self._matrix, self._noise = self.sensor.matrices(self._d)
        self._noise_root = np.linalg.cholesky(self._noise)
        self._look_at(raw.model)
        owners = [thing.track for thing in self._things]
        self.track_names = [thing.name for thing in self._things]
        self.tracking = Tracks([track.motion(self._d) for track in owners])
        self._start_std = np.stack([track.start(self._d) for track in owners])
        self._state_names = [*axes, *(f"v{axis}" for axis in axes)]
        self.last_seen_positions = np.zeros((len(self.track_names), self._d))
        self.permitted = np.zeros(len(self.track_names), dtype=bool)
        if self.observe:
            size = 3 * self._d * len(self.track_names)
            self._widen_observation("tracks", gym.spaces.Box(-np.inf, np.inf, (size,), np.float64))

    def _look_at(self, model: mujoco.MjModel) -> None:
        """Resolve names on a model."""
        s = self.sensor
        range_m = math.inf if s.range_m is None else s.range_m
        self._sight = LineOfSight(model, s.camera, s.site, s.view_deg, range_m)
        imu = s.imu
        self.ego_motion = EgoMotion(imu, self._sight) if isinstance(imu, Imu) else None
        self._things = tracked_things(model, self.tracks, self._published)
        self._bodies = np.array([thing.body for thing in self._things], dtype=np.intp)
        self._in_model = self._bodies >= 0

    def _published(self, track: Track) -> Array:
        points = np.asarray(read_attribute(self.env, track.published or ""), dtype=np.float64)
        if points.ndim != 2 or points.shape[1] not in (self._d, 3) or not len(points):
            wanted = f"positions of shape (k, {self._d}) or (k, 3), k >= 1"
            raise ConfigurationError(f"the env's {track.published} must be {wanted}, got {points.shape}")
        return points

    def _truth(self) -> tuple[Array, Array | None]:
        """True positions, shape (n, 3), m, and velocities, (n, d), m/s, if the sensor measures them."""
        sight = self._sight
        positions = np.empty((len(self.track_names), 3))
        if self._in_model.any():
            positions[self._in_model] = sight.data.xpos[self._bodies[self._in_model]]
        velocities = None
        if self.sensor.velocity_std is not None:
            velocities = np.empty((len(positions), self._d))
            for i in np.flatnonzero(self._in_model):
                velocities[i] = sight.velocity(int(self._bodies[i]))[0][: self._d]
        for track in self.tracks:
            if track.published is not None:
                points = self._published(track)
                which = [i for i, thing in enumerate(self._things) if thing.track is track]
                if len(points) != len(which):
                    counts = f"had {len(which)} points when the wrapper was made, and has {len(points)} now"
                    raise ConfigurationError(f"the env's {track.published} {counts}")
                positions[which, 2] = sight.position[2]  # a point of the plane is looked at level
                positions[which, : points.shape[1]] = points
        return positions, velocities

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Reset:
        """Reset the env, start every track from its initial fix, and look once."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._random.reset(self.env, seed)
        if self._sight.model is not self._raw.model:
            self._look_at(self._raw.model)
            names = [thing.name for thing in self._things]
            if names != self.track_names:
                tracked = f"{', '.join(names)} and not {', '.join(self.track_names)}"
                raise ConfigurationError(f"the env has another model, with other things: {tracked}")
        self._time = float(self._raw.data.time)
        self._sight.read(self._raw.data)
        if self.ego_motion is not None:
            self.ego_motion.fix_now()
        self._start()
        info.update(self._look())
        info[keys.OCCLUSION_PENALTY] = 0.0
        return self._observed(observation), info

    def step(self, action: Any) -> Step:
        """Step the env with the action as it is, and look."""
        observation, reward, terminated, truncated, info = self._pass_on(action)
        elapsed = self._elapsed()
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
        """Track name -> directions of its state ("x", "vy") that the sensor cannot resolve in sight."""
        return {
            name: list(unobservable_directions(motion.matrices()[0], self._matrix, self._state_names))
            for name, motion in zip(self.track_names, self.tracking.motions, strict=True)
        }

    def _elapsed(self) -> float:
        now = float(self._raw.data.time)
        elapsed, self._time = now - self._time, now
        if abs(elapsed - self._control_dt) < 1e-9:
            return self._control_dt
        if elapsed < 0.0:
            gone = f"backwards by {-elapsed:g} s within a step"
            raise SafeWrappersError(f"the simulation's time ran {gone}. Reset the env instead")
        return elapsed

    def _start(self) -> None:
        """The initial fix: truth plus noise of the declared size, and the declared mean velocity."""
        d, n = self._d, len(self.track_names)
        truth, _ = self._truth()
        mean = np.zeros((n, self.tracking.size))
        mean[:, :d] = truth[:, :d] + self._start_std[:, :d] * self._random.draw.standard_normal((n, d))
        mean[:, d:] = np.stack([motion.mean_velocity for motion in self.tracking.motions])
        self.tracking.start(mean, self._start_std[:, :, None] ** 2 * np.eye(self.tracking.size))
        self.last_seen_positions = mean[:, :d].copy()

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
