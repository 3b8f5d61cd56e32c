"""RolloutConstraint: the base of constraints that are judged on a rollout of the machine."""

import warnings
from abc import abstractmethod
from typing import Any, ClassVar, NamedTuple

import numpy as np

from safe_wrappers.checks import Array, check_fields, non_negative, positive, whole_number
from safe_wrappers.filter.constraint import BoundConstraint, Constraint, HalfSpaces, Memory
from safe_wrappers.filter.linearize import Tangents, differences, linearize
from safe_wrappers.plants.mujoco.forecast import Forecast
from safe_wrappers.plants.mujoco.plant import MujocoPlant, require_mujoco
from safe_wrappers.plants.plant import Plant

RECOVERY_S = 0.1  # time constant of recovery from a violation, s
_KEPT = 10
"""Control steps for which slopes are kept where controls are displacements; forecasts check what follows."""


class RolloutConstraint(Constraint):
    """A requirement along a forecast of the held control, and then of the actuated joints braking.

    A subclass is a dataclass with the fields `margin` (in `unit`), `horizon` (control intervals to look ahead) and
    `max_decrease` (in `unit`, or None: every control is forecast).
    """

    margin: float
    horizon: int
    max_decrease: float | None
    look_ahead_below: float | None = None
    euler_look_ahead: bool = False
    unit: ClassVar[str] = "units of the value"

    def _check_shared(self) -> None:
        self.margin = non_negative("margin", self.margin, self.unit)
        self.horizon = whole_number("horizon", self.horizon, 1, "control intervals to look ahead")
        check_fields(self, positive, ("max_decrease",), self.unit)


class BoundSlacks(BoundConstraint):
    """A requirement whose slacks along the step of a control a subclass predicts."""

    predicts: bool = True
    tolerance: float = 1e-9
    plant: MujocoPlant

    @abstractmethod
    def slacks(self, control: Array) -> Array:
        """What is left of the requirement in the step of a control, shape (k,), k the same for every control."""

    def slack(self, control: Array) -> float:
        """The least of the slacks; minus infinity where one is not a number."""
        least = float(self.slacks(control).min(initial=np.inf))
        return least if least == least else -np.inf

    def load(self) -> None:
        if self.value().size:
            self.rows()
            self.slacks(np.clip(0.0, self.plant.lower, self.plant.upper))

    def linearize(self, control: Array) -> HalfSpaces:
        return linearize(self.slacks, control, self.plant.lower, self.plant.upper)


class RolloutMemory(NamedTuple):
    """What a rollout constraint remembers of an episode."""

    recent: tuple[
        float, ...
    ] = ()  # what was left at the last states, the newest last, at most `horizon` of them
    slopes: Array | None = None  # of the slacks
    until: int = 0  # the observation until which they are kept


class BoundRollout(BoundSlacks):
    """A requirement `room >= margin` along a forecast of the held control, and then of braking.

    A subclass says what is left of its limit at the present state (`now`) and along a forecast (`room`).

    A forecast costs at least as much as a step of the env. A state with more than `max_decrease` left, the most that
    `value` can fall within it, needs none. The declaration is checked at every step, and dropped with a warning when
    broken.
    """

    spec: Any
    _value: Array

    def __init__(self, spec: RolloutConstraint, plant: Plant) -> None:
        hint = "forecasts with a MuJoCo model; on an AnalyticPlant use Barrier(h) or Clearance(...)"
        super().__init__(spec, require_mujoco(plant, f"{type(spec).__name__} {hint}"))
        self.max_decrease = spec.max_decrease

    @abstractmethod
    def room(self, forecast: Forecast) -> Array:
        """What is left of the limit along a forecast, in time: shape (instants, n)."""

    @abstractmethod
    def now(self) -> Array:
        """What is left of the limit at the present state, shape (n,)."""

    def start(self) -> Memory:
        return RolloutMemory()

    def observe(self, memory: RolloutMemory) -> None:
        self._value = self.now()
        self._known: dict[bytes, Array] = {}
        self._least = float(self._value.min(initial=np.inf))
        self._memory = memory
        self._outside = self._violation(self._value)
        keeps = self.plant.observation_id < memory.until and not self._outside.any()
        self._tangents = Tangents(self.slacks, self._slopes, memory.slopes if keeps else None)
        most, fallen = self.max_decrease, max(memory.recent, default=-np.inf) - self._least
        if most is not None and fallen > most + self.tolerance:
            warnings.warn(
                f"{type(self.spec).__name__}: what is left of the limit fell by {fallen:.3g} {self.spec.unit} within "
                f"{len(memory.recent)} control steps, farther than the declared max_decrease of {most:g}; from now "
                "on every control is forecast",
                stacklevel=2,
            )
            self.max_decrease = most = None
        self._far = most is not None and self._least - most >= self.spec.margin + self.tolerance

    def executed(self, control: Array) -> Memory:
        recent, slopes, until = self._memory
        recent = (*recent, self._least)[-self.spec.horizon :] if self.max_decrease is not None else ()
        if self._tangents.made and not (self.plant.has_acceleration or self._outside.any()):
            slopes, until = self._tangents.slopes, self.plant.observation_id + _KEPT
        return RolloutMemory(recent, slopes, until)

    def value(self) -> Array:
        return self._value

    def _violation(self, value: Array) -> Array:
        """The present violations that a forecast starts from, <= 0, shape (n,)."""
        return np.asarray(np.minimum(value - self.spec.margin, 0.0))

    def slacks(self, control: Array) -> Array:
        """What is left of what is asked for along the forecast of a control, shape (k,); wanted >= 0.

        In time: the least room in every control interval, bound by bound.
        """
        key = control.tobytes()
        if key not in self._known:
            self._known[key] = self._slacks(control)
        return self._known[key]

    def _slacks(self, control: Array) -> Array:
        inside, euler, gate = not self._outside.any(), self.spec.euler_look_ahead, self.spec.look_ahead_below
        if inside and gate is not None and self._least >= gate:
            held = self._least_rooms(self.plant.forecast(control, 1, euler), 1)
            if (held >= gate).all():
                return held
        forecast = self.plant.forecast(control, self.spec.horizon, euler)
        if inside:
            return self._least_rooms(forecast, self.spec.horizon)
        return self._back_inside(forecast)

    def _least_rooms(self, forecast: Forecast, holds: int) -> Array:
        left = self.room(forecast) - self.spec.margin
        return np.asarray(left.reshape(holds, -1, left.shape[1]).min(axis=1).ravel())

    def _back_inside(self, forecast: Forecast) -> Array:
        """From outside, bound by bound: no farther out on the way, and closer at the end."""
        left = self.room(forecast) - self.spec.margin
        return np.concatenate([left.min(axis=0) - self._outside, left[-1] - self._closer()])

    def _slopes(self, control: Array) -> Array:
        """How the slacks change with a control, shape (k, nu), by differences of sketches of the forecast.

        Left out are those of the control intervals after the last one in which a bound is violated most.
        """
        plant, horizon, box = self.plant, self.spec.horizon, (self.plant.lower, self.plant.upper)
        if self._outside.any():
            return differences(lambda u: self._back_inside(plant.sketch(u, horizon)), control, *box)
        left = self.slacks(control).reshape(horizon, -1)
        needed = int(np.where(left.min(axis=0) < 0.0, left.argmin(axis=0), 0).max()) + 1
        return differences(lambda u: self._least_rooms(plant.sketch(u, needed), needed), control, *box)

    def _closer(self) -> Array:
        """What is left of the present violations at the end of a forecast, <= 0, shape (n,)."""
        return np.asarray(self._outside * np.exp(-self.spec.horizon * self.plant.control_dt / RECOVERY_S))

    def admits(self, control: Array) -> bool:
        """Whether the forecast keeps the margin (from outside: whether it comes back towards it)."""
        return self._far or super().admits(control)

    def linearize(self, control: Array) -> HalfSpaces:
        return self._tangents.about(control)

    def rows(self) -> HalfSpaces:
        """Where controls are displacements: tangents about braking; else none.

        A refused displacement may press the machine against something, and then says little about others.
        """
        if self.plant.has_acceleration or self._far:
            return super().rows()
        return self._tangents.about(self.plant.braking())
