"""SpeedLimit: how fast a body, or the machine's centre of mass, may move."""

from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from safe_wrappers.checks import Array, check_fields, positive, true_or_false
from safe_wrappers.constraints.rollout import BoundRollout, Recent, RolloutConstraint
from safe_wrappers.errors import ConfigurationError, UnknownNameError
from safe_wrappers.filter.constraint import Memory
from safe_wrappers.plants.mujoco.forecast import Forecast
from safe_wrappers.plants.plant import Plant

DIRECTIONS = ("+x", "-x", "x", "+y", "-y", "y", "+z", "-z", "z", "xy", "xyz")


@dataclass
class SpeedLimit(RolloutConstraint):
    """Keep the speed of a body, or of the centre of mass, below a limit.

    Speed is displacement over time, as Gymnasium's `x_velocity` is. Over a control step two displacements count: from
    state to state, and that of MuJoCo's `data.xpos`, from which Gymnasium reads Ant's and Humanoid's speed.

    Best effort: the control step of an executed control that is not flagged keeps the limit, for a plant that is
    right. Such a control need not exist: in flight no actuator changes the momentum, and contact forces have one
    sign.

    Args:
        limit: m/s.
        body: Name of the body whose frame origin counts; None: the whole machine's centre of mass.
        direction: "+x" and so on limit one sign, "x" both, "xy" and "xyz" the length of the vector.
        average: "step" over a control step, "substep" over a physics substep.
        margin: Kept free below the limit, m/s.
        horizon: Control steps to forecast; the actuated joints brake after the first.
        max_decrease: The most that the speed can rise within `horizon` control steps, m/s; states with more than that
            left need no forecast.
        look_ahead_below: m/s; a control that leaves at least this much after its own control step is admitted without
            a look at the others. None: always look.
        euler_look_ahead: Look at the others by Euler steps where the model's own are Runge-Kutta's, at a quarter of
            the price. The first control step is always simulated by the model's own.
    """

    limit: float
    body: str | None = None
    direction: str = "xy"
    average: Literal["step", "substep"] = "step"
    margin: float = 0.0
    horizon: int = 3
    max_decrease: float | None = None
    look_ahead_below: float | None = None
    euler_look_ahead: bool = False

    unit: ClassVar[str] = "m/s"

    def __post_init__(self) -> None:
        self._check_shared()
        check_fields(self, positive, ("limit", "look_ahead_below"), "m/s")
        self.euler_look_ahead = true_or_false("euler_look_ahead", self.euler_look_ahead)
        if self.margin >= self.limit:
            raise ConfigurationError(f"the margin {self.margin} leaves nothing of the limit {self.limit}")
        if self.direction not in DIRECTIONS:
            raise UnknownNameError(f"no direction {self.direction!r}; choose {', '.join(DIRECTIONS)}")
        if self.average not in ("step", "substep"):
            raise UnknownNameError(f"no average {self.average!r}; choose step or substep")

    def bind(self, plant: Plant) -> "BoundSpeedLimit":
        return BoundSpeedLimit(self, plant)


class SpeedMemory(NamedTuple):
    """The memory of every rollout, and the point at the last control step, m (None: there was none)."""

    recent: Recent
    here: Array | None = None


class BoundSpeedLimit(BoundRollout):
    """SpeedLimit on a plant."""

    spec: SpeedLimit

    @property
    def scale(self) -> float:
        return self.spec.limit

    def __init__(self, spec: SpeedLimit, plant: Plant) -> None:
        super().__init__(spec, plant)
        self._body = None if spec.body is None else self.plant.named("body", spec.body)
        letters = spec.direction.strip("+-")
        self._axes = slice("xyz".index(letters[0]), "xyz".index(letters[-1]) + 1)
        self._sign = {"+": 1.0, "-": -1.0}.get(spec.direction[0])
        self._window = self.plant.substeps if self.spec.average == "step" else 1

    def start(self) -> Memory:
        return SpeedMemory(super().start())

    def observe(self, memory: Memory) -> None:
        self._before = memory.here
        super().observe(memory.recent)

    def executed(self, control: Array) -> Memory:
        return SpeedMemory(super().executed(control), self._here)

    def _point(self, frames: Array, centres: Array) -> Array:
        if self._body is None:
            return np.asarray((self._shares @ centres)[..., self._axes])
        return frames[..., self._body, self._axes]

    def now(self) -> Array:
        if self._body is None:
            mass = self.plant.model.body_mass
            self._shares = mass / mass.sum()
        pose = self.plant.pose()
        data = self.plant.published() if self.spec.average == "step" else None
        self._published = None if data is None else self._point(data.xpos, data.xipos).copy()
        before, self._here = self._before, self._point(pose.xpos, pose.xipos).copy()
        if before is None or self.spec.average == "substep":
            # What the last substep shows; at a reset nothing else has moved yet that could be measured.
            earlier = self.plant.substep_ago()
            moved = self._here - self._point(earlier.frames[0], earlier.centres[0])
            return self._left(moved[None], 1)
        return self._left((self._here - before)[None], self.plant.substeps)

    def _left(self, displacements: Array, substeps: int) -> Array:
        """What is left below the limit, shape (...,), of displacements over so many substeps, shape (..., axes)."""
        velocity = displacements / (substeps * self.plant.control_dt / self.plant.substeps)
        if self._sign is not None:
            return self.spec.limit - self._sign * velocity[..., 0]
        return np.asarray(self.spec.limit - np.sqrt((velocity * velocity).sum(axis=-1)))

    def _violation(self, value: Array) -> Array:
        return np.zeros(1)  # the next step's displacement starts afresh: there is no way back to allow for

    def room(self, forecast: Forecast) -> Array:
        poses = forecast.poses(self._window)
        points = self._point(poses.frames, poses.centres)
        way = np.empty((len(points) + 1, 1 if self._published is None else 2, points.shape[1]))
        way[0, 0], way[1:, 0] = self._here, points
        if self._published is not None:
            way[0, 1] = self._published
            way[1:, 1] = self._point(forecast.published_frames, forecast.published_centres)
        return self._left(way[1:] - way[:-1], self._window)
