"""OcclusionPenalty: what is not seen is estimated, and not to see costs reward."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar, SupportsFloat

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers import info as keys
from safe_wrappers.checks import non_negative, positive
from safe_wrappers.control.estimation.covariance import blind_time
from safe_wrappers.control.estimation.observability import linear_observability
from safe_wrappers.control.estimation.tracks import Tracks, largest_deviation
from safe_wrappers.errors import ConfigurationError, SafeWrappersError
from safe_wrappers.plants.env_checks import read_attribute
from safe_wrappers.plants.mujoco.binding import control_interval
from safe_wrappers.plants.queries.line_of_sight import LineOfSight
from safe_wrappers.stack import Layer, refuse_order
from safe_wrappers.wrappers.common.wrapper_rng import WrapperRng
from safe_wrappers.wrappers.occlusion.measured import measured
from safe_wrappers.wrappers.occlusion.sensor import Sensor, sensor_from
from safe_wrappers.wrappers.occlusion.things import check_env, tracked_things, with_tracks
from safe_wrappers.wrappers.occlusion.track import Track, track_from

Array = NDArray[np.float64]

_AXES = ("x", "y", "z")


class OcclusionPenalty(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Estimates what a sensor on the robot sees, and sees no more, and takes a penalty off the reward for not seeing.

    After every step it casts a ray to each tracked point, all in one call. What is in sight is measured, with noise,
    and updates the track's Kalman estimate; what is not grows less certain, as the Lyapunov equation says, exactly.
    Four things come of it, each of which can be used without the others:

    - **Reward**: `weight` times the mean, over the tracks within the sensor's range, of
      ``min(1, sigmas * sigma / tolerance) ** 2``, is taken off. `weight=0` leaves the reward alone.
    - **Observation** (`observe`): for each track the estimated position relative to the sensor's body (m, world
      axes), the estimated velocity (m/s) and the standard deviation along each axis (m), appended to a flat Box, or
      under the key "tracks" of a Dict. The tracks' true states are not in it.
    - **Permission**: a track's permission to be relied on expires *before* ``sigmas * sigma`` crosses `tolerance`,
      one control step ahead, and comes back when it is seen. `TrackPermission` stops the machine then; `permissions`
      says for how long they would last.
    - **The filter around it**: `TrackedDiscs` are obstacles that are as much larger as the estimates are uncertain,
      so `Clearance` and the like keep k sigma more distance and the robot that sees less moves more carefully.

    **What it promises.** If the tracked things move as declared, the sensor's noise is as declared, and nothing else
    is measured than what is in sight, then the errors have the covariances that are given: see the tails in
    `appendix.estimation.sigma_coverage` for what k sigma means. It is no hard bound, and not about things that are
    not tracked. An estimate that is one step old is never used: the estimate is of the state that the action acts on.

    **Order.** Inside the filter, which reads the estimates: ``CBFActionFilter(OcclusionPenalty(env, ...), ...)``.
    Returns that are recorded outside hold the penalty; `RecordInterventions` adds it back.

    Args:
        env: Its unwrapped env has MuJoCo's `.model` and `.data`.
        tracks: Each a `Track`, or the dict of a recorded one.
        sensor: A `Sensor`, or the name of a camera in the model.
        tolerance: Position error that the task can bear, m.
        weight: Of the penalty, in units of the task's reward per step.
        sigmas: k of the bound that is compared with the tolerance.
        axes: "xy" tracks in the plane, "xyz" in space.
        observe: Whether the observation gains the estimates.

    Info, at every step and at reset: ``occlusion/visible``, ``occlusion/expired`` (bool arrays, one per track),
    ``occlusion/sigma`` (m, array), ``occlusion/penalty``, ``occlusion/task_reward`` (float).

    Attributes:
        tracking: The `control.estimation.tracks.Tracks`: positions, velocities, covariances, and those ahead. What
            `TrackedDiscs` read.
        track_names: One per track: the body's name, or the attribute's with an index.
        last_seen_positions: Where each was measured to be last, shape (n, d), m; before that, the initial fix.
        permitted: Tracks that may be relied on, bool (n,).
        unobservable: Track name -> directions of its state that this sensor cannot resolve even in sight, in the
            names of the state ("x", "vy"); empty for a sensor that measures positions.

    Raises:
        UnsupportedEnvError: No MuJoCo model, or with `observe` neither a flat Box nor a Dict observation.
        UnknownNameError: No such camera, site, body or attribute; the message lists those there are.
        ConfigurationError: A number outside its range, a covariance that is none, no track, a second
            OcclusionPenalty, or a filter or `ChunkHandover` inside.
        SafeWrappersError: At a step: the simulation's time ran backwards.

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

    Change log:
        * v0.1.0: added.
    """

    layer: ClassVar = Layer.OCCLUSION

    def __init__(
        self,
        env: gym.Env[Any, Any],
        tracks: Sequence[Track | dict[str, Any]],
        sensor: Sensor | str | dict[str, Any],
        tolerance: float,
        weight: float = 0.0,
        sigmas: float = 3.0,
        axes: str = "xy",
        observe: bool = True,
    ) -> None:
        raw: Any = env.unwrapped
        check_env(env)
        refuse_order(env, self.layer, type(self).__name__)
        if isinstance(tracks, str | dict) or not isinstance(tracks, Sequence) or not tracks:
            raise ConfigurationError(f"tracks is a list with at least one Track, got {tracks!r}")
        self.tracks = [track_from(t) for t in tracks]
        self.sensor = sensor_from(sensor)
        if self.sensor.velocity_std is not None and any(t.published is not None for t in self.tracks):
            raise ConfigurationError(
                "velocity_std: velocities are measured of bodies; of positions that the env publishes none are known"
            )
        self.tolerance = positive("tolerance", tolerance, "m")
        self.weight = non_negative("weight", weight, "the task's reward per step")
        self.sigmas = positive("sigmas", sigmas, "standard deviations")
        if axes not in ("xy", "xyz"):
            raise ConfigurationError(f"axes is 'xy' or 'xyz', got {axes!r}")
        if not isinstance(observe, bool | np.bool_):
            raise ConfigurationError(f"observe is True or False, got {observe!r}")
        gym.utils.RecordConstructorArgs.__init__(
            self,
            tracks=[t.data() for t in self.tracks],
            sensor=self.sensor.data(),
            tolerance=self.tolerance,
            weight=self.weight,
            sigmas=self.sigmas,
            axes=axes,
            observe=bool(observe),
        )
        gym.Wrapper.__init__(self, env)
        self._raw, self._d, self._random = raw, len(axes), WrapperRng("OcclusionPenalty")
        self._control_dt = control_interval(raw)
        self._matrix, self._noise = self.sensor.matrices(self._d)
        self._noise_root = np.linalg.cholesky(self._noise)
        self._look_at(raw.model)
        self.tracking = Tracks([m for t, count in self._counted for m in [t.motion(self._d)] * count])
        self._start_std = [
            np.concatenate([np.tile(t.start(self._d)[k], (count, 1)) for t, count in self._counted])
            for k in (0, 1)
        ]
        self.unobservable = self._unobservable(axes)
        self.last_seen_positions = np.zeros((len(self.track_names), self._d))
        self.permitted = np.zeros(len(self.track_names), dtype=bool)
        self.observe = bool(observe)
        if observe:
            self.observation_space = with_tracks(env.observation_space, 3 * self._d * len(self.track_names))

    # What is tracked, and from where --------------------------------------------------------------------------

    def _look_at(self, model: mujoco.MjModel) -> None:
        """Resolve names on a model."""
        s = self.sensor
        range_m = math.inf if s.range_m is None else s.range_m
        self._sight = LineOfSight(model, s.camera, s.site, s.view_deg, range_m, s.occluder_groups)
        bodies, self.track_names, counts = tracked_things(model, self.tracks, self._published)
        self._counted = list(zip(self.tracks, counts, strict=True))
        if len(set(self.track_names)) < len(self.track_names):
            twice = sorted({n for n in self.track_names if self.track_names.count(n) > 1})
            raise ConfigurationError(f"each thing is tracked once; these are named twice: {', '.join(twice)}")
        self._bodies = np.array(bodies, dtype=np.intp)
        self._in_model = self._bodies >= 0

    def _look_at_another(self, model: mujoco.MjModel) -> None:
        """The env has another model now; the tracks must be the same."""
        before = self.track_names
        self._look_at(model)
        if self.track_names != before:
            raise ConfigurationError(
                f"the env has another model than when the wrapper was made, with other things to track: "
                f"{', '.join(self.track_names)} and not {', '.join(before)}"
            )

    def _published(self, track: Track) -> Array:
        points = np.asarray(read_attribute(self.env, track.published or ""), dtype=np.float64)
        if points.ndim != 2 or points.shape[1] not in (self._d, 3) or not len(points):
            raise ConfigurationError(
                f"the env's {track.published} must be positions of shape (k, {self._d}) or (k, 3), k >= 1, got shape "
                f"{points.shape}; how many there are is read when the wrapper is made"
            )
        return points

    def _unobservable(self, axes: str) -> dict[str, list[str]]:
        names = [*axes, *(f"v{axis}" for axis in axes)]
        directions: list[list[str]] = []
        for track, count in self._counted:
            a, _, _ = track.motion(self._d).matrices()
            directions += [list(linear_observability(a, self._matrix, names).names)] * count
        return dict(zip(self.track_names, directions, strict=True))

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
        at = 0
        for track, count in self._counted:
            if track.published is not None:
                points = self._published(track)
                if len(points) != count:
                    raise ConfigurationError(
                        f"the env's {track.published} had {count} points when the wrapper was made, and has "
                        f"{len(points)} now; things that come and go cannot be tracked"
                    )
                there = positions[at : at + count]
                there[:, 2] = sight.position[2]  # a point of the plane is looked at level
                there[:, : points.shape[1]] = points
            at += count
        return positions, velocities

    # Gymnasium --------------------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the env, start every track from its initial fix, and look once."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._random.reset(self.env, seed)
        if self._sight.model is not self._raw.model:
            self._look_at_another(self._raw.model)
        self._time = float(self._raw.data.time)
        self._sight.read(self._raw.data)
        self._start()
        self._look()
        info[keys.OCCLUSION_PENALTY] = info[keys.OCCLUSION_TASK_REWARD] = 0.0
        self._tell(info)
        return self._observed(observation), info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step the env with the action as it is, and look."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.tracking.advance(self._elapsed())
        self._sight.read(self._raw.data)
        self._look()
        penalty = self.weight * self._uncertainty() if self.weight else 0.0
        info[keys.OCCLUSION_TASK_REWARD] = float(reward)
        info[keys.OCCLUSION_PENALTY] = penalty
        self._tell(info)
        if penalty:
            reward = float(reward) - penalty
        return self._observed(observation), reward, terminated, truncated, info

    def permissions(self, horizon_s: float = 60.0) -> Array:
        """How long each track may still be relied on if nothing is seen from now on, s, shape (n,).

        Until the bound is at the tolerance: `permitted` ends a control step before. 0 where it is there already; inf
        where it is not reached within the horizon.
        """
        direction = np.eye(self._d, 2 * self._d)
        times = []
        for i, motion in enumerate(self.tracking.motions):
            a, _, q = motion.matrices()
            covariance = self.tracking.covariance[i]
            times.append(blind_time(covariance, a, q, direction, self.tolerance, self.sigmas, horizon_s))
        return np.array(times)

    # Estimating ---------------------------------------------------------------------------------------------------

    def _elapsed(self) -> float:
        now = float(self._raw.data.time)
        elapsed, self._time = now - self._time, now
        if abs(elapsed - self._control_dt) < 1e-9:
            return self._control_dt
        if elapsed < 0.0:
            raise SafeWrappersError(
                f"the simulation's time ran backwards by {-elapsed:g} s within a step; an estimate cannot. Reset the "
                "env instead of setting an earlier state"
            )
        return elapsed

    def _start(self) -> None:
        """The initial fix: truth plus noise of the declared size, and the declared mean velocity."""
        d, n = self._d, len(self.track_names)
        position_std, velocity_std = self._start_std
        truth, _ = self._truth()
        mean = np.zeros((n, 2 * d))
        mean[:, :d] = truth[:, :d] + position_std * self._random.draw.standard_normal((n, d))
        mean[:, d:] = np.stack([motion.mean_velocity for motion in self.tracking.motions])
        covariance = np.zeros((n, 2 * d, 2 * d))
        diagonal = np.concatenate([position_std, velocity_std], axis=1) ** 2
        covariance[:, np.arange(2 * d), np.arange(2 * d)] = diagonal
        self.tracking.start(mean, covariance)
        self.last_seen_positions = mean[:, :d].copy()

    def _look(self) -> None:
        """Measure what is in sight, and say what may be relied on."""
        d, n = self._d, len(self.track_names)
        truth, velocities = self._truth()
        seen = self._sight.sees(truth, self._bodies)
        # Drawn for every track, seen or not, so that the noise of one does not depend on another's sight.
        noise = self._random.draw.standard_normal((n, self._noise.shape[0])) @ self._noise_root.T
        if self.sensor.dropout:
            seen &= self._random.draw.random(n) >= self.sensor.dropout
        which = np.flatnonzero(seen)
        if which.size:
            among = None if velocities is None else velocities[which]
            measurements = measured(self.sensor, self._sight, d, truth[which], among)
            measurements += noise[which]
            self.tracking.see(which, measurements, self._matrix, self._noise)
            if self.sensor.position_std is not None:
                self.last_seen_positions[which] = measurements[:, :d]
        self._visible = seen
        self._sigma = largest_deviation(self.tracking.position_covariances)
        soon = largest_deviation(self.tracking.ahead([self._control_dt])[1][0])
        self.permitted = self.sigmas * np.maximum(self._sigma, soon) <= self.tolerance

    def _uncertainty(self) -> float:
        """Mean share of the tolerated variance that is used up, over the tracks within range."""
        share = np.minimum(1.0, self.sigmas * self._sigma / self.tolerance) ** 2
        if self.sensor.range_m is None:
            return float(share.mean())
        away = self.tracking.positions - self._sight.position[: self._d]
        near = (away * away).sum(axis=1) <= self.sensor.range_m**2
        return float(share[near].mean()) if near.any() else 0.0

    def _tell(self, info: dict[str, Any]) -> None:
        info[keys.OCCLUSION_VISIBLE] = self._visible.copy()
        info[keys.OCCLUSION_SIGMA] = self._sigma.copy()
        info[keys.OCCLUSION_EXPIRED] = ~self.permitted

    def _observed(self, observation: Any) -> Any:
        if not self.observe:
            return observation
        body = self._sight.data.xpos[self._sight.body, : self._d]
        tracking = self.tracking
        deviations = np.sqrt(np.diagonal(tracking.position_covariances, axis1=1, axis2=2))
        flat = np.concatenate([tracking.positions - body, tracking.velocities, deviations], axis=1).ravel()
        if isinstance(observation, dict):
            return observation | {"tracks": flat}
        return np.concatenate([observation, flat.astype(observation.dtype)])
