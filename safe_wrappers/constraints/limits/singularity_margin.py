"""SingularityMargin: the manipulability of a point of an arm stays above a threshold."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np

from safe_wrappers.checks import Array, check_fields, name_list, positive
from safe_wrappers.constraints.limits.serial_chain import FrameKind, SerialChain
from safe_wrappers.constraints.rollout import BoundRollout, RolloutConstraint
from safe_wrappers.control.filtering import manipulability as of_arm
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.constraint import HalfSpaces
from safe_wrappers.plants.mujoco.forecast import Forecast
from safe_wrappers.plants.plant import Plant

_SAMPLES = 2000  # configurations that say which manipulability can be reached
_STILL = 1e-9  # columns with a smaller norm are zero, m or rad per rad
# Time constant of the rows, control intervals: a longer one brakes early, a shorter one is refused by forecasts.
_DECAY_HOLDS = 2.0
_ALONG_S = 1e-5  # width of the difference for the curvature of w along the motion, s


@dataclass
class SingularityMargin(RolloutConstraint):
    """Keep the manipulability `w = sqrt(det(J J'))` of a frame, for declared task directions, above a threshold.

    With `task_speed` and `rate_limit` the threshold is the smallest w above which none of 2,000 sampled
    configurations needs more than the limit at that speed. w itself bounds no joint rate.

    Best effort: an executed control that is not flagged keeps the threshold at every physics substep of its step, for
    a plant that is right. Gravity, contacts and coupling can be stronger than the actuators.

    Args:
        threshold: Smallest w, in m^k for k translations and hinges (times `length` to the number of rotations).
        site: Name of the site whose motion the task is about; or
        body: of a body, meaning its frame's origin; or
        geom: of a geom, meaning its centre.
        directions: Of translation, some of "xyz".
        rotations: About these axes, some of "xyz".
        length: Length that weighs a rotation against a translation, m; needed if there are both.
        frame: Axes of directions and rotations: the "world"'s or the frame's "own".
        joints: Names of those that do the task. None: those that an actuator drives directly and that move the frame.
        task_speed: Speed that has to be possible in every direction, m/s (rad/s for rotations alone).
        rate_limit: Largest rate of each joint at that speed, rad/s for hinges, m/s for slides.
        margin: Kept free above the threshold, as a share of it.
        horizon: Control steps to forecast; cover the braking time.
        max_decrease: The most that w can fall within `horizon` steps, in shares of the threshold. None: unknown.

    Attributes:
        validated: What the sample said of the threshold; None if it was given, or before the constraint is bound.
    """

    threshold: float | None = None
    site: str | None = None
    body: str | None = None
    geom: str | None = None
    directions: str = "xyz"
    rotations: str = ""
    length: float | None = None
    frame: Literal["world", "own"] = "world"
    joints: Sequence[str] | None = None
    task_speed: float | None = None
    rate_limit: float | None = None
    margin: float = 0.0
    horizon: int = 5
    max_decrease: float | None = None

    validated: of_arm.ValidatedThreshold | None = field(default=None, init=False, repr=False, compare=False)
    unit: ClassVar[str] = "shares of the threshold"

    def __post_init__(self) -> None:
        self._check_shared()
        speed, limit = self.task_speed, self.rate_limit
        given, validated = self.threshold is not None, speed is not None and limit is not None
        if given is validated or (given and (speed is not None or limit is not None)):
            raise ConfigurationError(
                "give a threshold on the manipulability, or a task_speed and a rate_limit to validate one for; got "
                f"threshold={self.threshold!r}, task_speed={self.task_speed!r}, rate_limit={self.rate_limit!r}"
            )
        check_fields(self, positive, ("threshold",), "units of manipulability")
        check_fields(self, positive, ("task_speed",), "task units per second")
        check_fields(self, positive, ("rate_limit",), "rad/s or m/s")
        kinds: tuple[FrameKind, ...] = ("site", "body", "geom")
        named = [kind for kind in kinds if getattr(self, kind) is not None]
        if len(named) != 1 or not isinstance(getattr(self, named[0]), str):
            found = ", ".join(f"{kind}={getattr(self, kind)!r}" for kind in kinds)
            raise ConfigurationError(f"name the one site, body or geom that the task moves; got {found}")
        self._kind = named[0]
        if self.frame not in ("world", "own"):
            raise ConfigurationError(f'frame is "world" or "own", got {self.frame!r}')
        if self.joints is not None:
            self.joints = name_list("joints", self.joints, also="None for every driven joint")
        self._rows, self._weights = of_arm.task_rows(self.directions, self.rotations, self.length)

    def bind(self, plant: Plant) -> "BoundSingularityMargin":
        return BoundSingularityMargin(self, plant)


class BoundSingularityMargin(BoundRollout):
    """SingularityMargin on a plant."""

    spec: SingularityMargin

    def __init__(self, spec: SingularityMargin, plant: Plant) -> None:
        super().__init__(spec, plant)
        name = getattr(spec, spec._kind)
        what = f"the {spec._kind} {name!r}"
        self._chain = SerialChain(self.plant, self.spec._kind, name)
        self._columns = self._chain.columns(self.spec.joints)
        sampled = self._chain.sample(np.random.default_rng(0), _SAMPLES)
        idle = np.linalg.norm(self._task(sampled), axis=1).max(axis=0) < _STILL
        if self.spec.joints is not None and idle.any():
            still = self._chain.name(self._columns[int(np.argmax(idle))])
            nowhere = "in none of the task's directions: leave it out"
            raise ConfigurationError(f"the joint {still!r} moves {what} {nowhere}")
        self._columns = [c for c, does_nothing in zip(self._columns, idle, strict=True) if not does_nothing]
        task = f"directions={self.spec.directions!r}, rotations={self.spec.rotations!r}"
        count, wanted = len(self._columns), len(self.spec._rows)
        if count < wanted:
            there = ", ".join(map(self._chain.name, self._columns)) or "none"
            raise ConfigurationError(
                f"{count} joints cannot move {what} in {wanted} directions at once ({task}); the joints are {there}"
            )
        # With as many joints as directions w is the determinant but for its sign, which turns at a singular pose.
        self._signed, self._side = count == wanted, 1.0
        found = np.abs(self._measure(sampled))
        most = float(found.max())
        if most < _STILL:
            nowhere = "cannot be moved in all of these directions at once in any configuration"
            raise ConfigurationError(f"{what} {nowhere}: {task}, frame={self.spec.frame!r}")
        if spec.threshold is not None:
            self._threshold = spec.threshold
        else:
            assert spec.task_speed is not None and spec.rate_limit is not None
            jacobians = self._task(sampled)
            spec.validated = of_arm.validated_threshold(jacobians, spec.task_speed, spec.rate_limit)
            self._threshold = spec.validated.threshold
        if self._threshold * (1.0 + self.spec.margin) >= most:
            raise ConfigurationError(
                f"no configuration has a manipulability above {self._threshold:g} with a margin of "
                f"{self.spec.margin:g} of it: the largest of {_SAMPLES} in the joints' ranges is {most:.4g}, half of "
                f"them are above {float(np.median(found)):.4g}"
            )

    def _task(self, qpos: Array) -> Array:
        """Shape (k, m, n)."""
        return self._chosen(self._in_frame(*self._chain.jacobians(qpos)))

    def _chosen(self, jacobians: Array) -> Array:
        """The task's directions, weighed, and the joints that do it, shape (..., m, n)."""
        chosen = jacobians[..., self.spec._rows, :][..., self._columns]
        return np.asarray(chosen * self.spec._weights[:, None])

    def _in_frame(self, jacobians: Array, axes: Array) -> Array:
        """Six rows in the declared axes, shape (k, ..., 6, n)."""
        if self.spec.frame == "world":
            return jacobians
        back = np.swapaxes(axes, -1, -2)
        back = back.reshape(len(back), *(1,) * (jacobians.ndim - 3), 3, 3)
        return np.concatenate([back @ jacobians[..., :3, :], back @ jacobians[..., 3:, :]], axis=-2)

    def _measure(self, qpos: Array) -> Array:
        """w, shape (k,), below zero beyond the singular pose; NaN where a position is not finite."""
        w, finite = np.full(len(qpos), np.nan), np.isfinite(qpos).all(axis=1)
        task = self._task(qpos[finite])
        w[finite] = self._side * np.linalg.det(task) if self._signed else of_arm.manipulability(task)
        return w

    def now(self) -> Array:
        self._chain.place(self.plant.pose())
        self._side = 1.0
        w = self._measure(self.plant.qpos[None])
        if w[0] < 0.0:
            self._side, w = -1.0, -w
        return np.asarray(w / self._threshold - 1.0)

    def room(self, forecast: Forecast) -> Array:
        return np.asarray(self._measure(forecast.qpos) / self._threshold - 1.0)[:, None]

    def _slope(self, qpos: Array) -> Array:
        """dw/dq over the chain's joints, shape (k, n)."""
        jacobians, axes = self._chain.jacobians(qpos)
        change = of_arm.chain_derivative(jacobians[:, :3], jacobians[:, 3:])
        if self.spec.frame == "own":
            # The axes turn with the joints, too.
            turning = np.swapaxes(jacobians[:, 3:], 1, 2)[:, :, None, None, :]  # of joint k
            blocks = np.swapaxes(jacobians.reshape(len(qpos), 2, 3, -1), 2, 3)[:, None]
            carried = np.swapaxes(np.cross(turning, blocks), 3, 4)
            change = change - carried.reshape(change.shape)
        task, moved = (self._chosen(self._in_frame(part, axes)) for part in (jacobians, change))
        return of_arm.manipulability_gradient(task, moved)

    def rows(self) -> HalfSpaces:
        """One row `w'' + 2 a w' + a^2 (w - threshold) >= 0`, a first guess for the forecast, which decides."""
        if not (self._chain.scalar and self.plant.has_acceleration):
            return super().rows()
        drift, effect = self.plant.acceleration
        speeds = self.plant.qvel[self._chain.dofs]
        along = np.tile(self.plant.qpos, (3, 1))
        along[1:, self._chain.qpos] += np.outer([_ALONG_S, -_ALONG_S], speeds)
        slope, ahead, behind = self._slope(along) / self._threshold
        curvature = (ahead - behind) @ speeds / (2.0 * _ALONG_S)
        a = 1.0 / (_DECAY_HOLDS * self.plant.control_dt)
        left = 2.0 * a * (slope @ speeds) + a * a * (self._least - self.spec.margin)
        drift, effect = drift[self._chain.dofs], effect[self._chain.dofs]
        return HalfSpaces(-(slope @ effect)[None], np.array([slope @ drift + curvature + left]))
