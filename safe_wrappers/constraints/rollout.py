"""RolloutConstraint: the base of constraints that are judged on a rollout of the machine."""

import warnings
from abc import abstractmethod
from typing import Any, ClassVar, NamedTuple

import numpy as np

from safe_wrappers.checks import Array, check_fields, non_negative, positive, whole_number
from safe_wrappers.filter.constraint import BoundConstraint, Constraint, HalfSpaces, Memory
from safe_wrappers.filter.linearize import Tangents, differences, linearize, tangent_rows
from safe_wrappers.plants.mujoco.forecast import Forecast
from safe_wrappers.plants.mujoco.plant import MujocoPlant, require_mujoco
from safe_wrappers.plants.plant import Plant

_STEP = 1e-4  # width of the differences about braking, as a share of the control's range
_INSTANTS = (1, 2, 3, 5, 8, 13, 21, 34, 55)  # of a control interval that get rows, beside its last
_KEPT = 10  # control steps for which a response is kept: a guess that forecasts check
_SAME_RESPONSE = 1  # linearisations of one step that use the kept response
_RESOLUTION = 1e-6  # rounding of controls, as a share of half their range, for which rows are tightened
RECOVERY_S = 0.1  # time constant of recovery from a violation, s


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
        whole = isinstance(self.horizon, float | np.floating) and float(self.horizon).is_integer()
        horizon = int(self.horizon) if whole else self.horizon
        self.horizon = whole_number("horizon", horizon, 1, "control intervals to look ahead")
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
            self.slacks(np.clip(0.0, self.plant.lower, self.plant.upper))

    def linearize(self, control: Array) -> HalfSpaces:
        return linearize(self.slacks, control, self.plant.lower, self.plant.upper)


class RolloutMemory(NamedTuple):
    """What a rollout constraint remembers of an episode."""

    # What was left at the last states, the newest last, at most `horizon` of them.
    least: tuple[float, ...] = ()
    # How what is left changes with a control, and the observation until which that is kept; None: not known.
    response: tuple[Array, int] | None = None


class BoundRollout(BoundSlacks):
    """A requirement `room >= margin` along a forecast of the held control, and then of braking.

    A subclass says what is left of its limit at the present state (`now`) and along a forecast (`room`).

    A forecast costs at least as much as a step of the env. A state with more than `max_decrease` left, the most that
    `value` can fall within it, needs none. The declaration is checked at every step, and dropped with a warning when
    broken.
    """

    spec: Any
    _value: Array
    _response: tuple[Array, int] | None

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
        self._tangents = Tangents(self.slacks, self._slopes)
        self._linear: HalfSpaces | None = None
        self._linearized = 0
        self._least = float(self._value.min(initial=np.inf))
        self._recent, self._response = memory
        self._outside = self._violation(self._value)
        most, fallen = self.max_decrease, max(self._recent, default=-np.inf) - self._least
        if most is not None and fallen > most + self.tolerance:
            warnings.warn(
                f"{type(self.spec).__name__}: what is left of the limit fell by {fallen:.3g} {self.spec.unit} within "
                f"{len(self._recent)} control steps, farther than the declared max_decrease of {most:g}; from now on "
                "every control is forecast",
                stacklevel=2,
            )
            self.max_decrease = most = None
        self._far = most is not None and self._least - most >= self.spec.margin + self.tolerance

    def executed(self, control: Array) -> Memory:
        recent = (*self._recent, self._least)[-self.spec.horizon :] if self.max_decrease is not None else ()
        return RolloutMemory(recent, self._response)

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
        if self.plant.has_acceleration:
            return self._tangents.about(control)
        self._linearized += 1
        if self._linearized > _SAME_RESPONSE:
            self._respond(control)
        return self._instants(control)

    def rows(self) -> HalfSpaces:
        """Where controls are displacements: the forecast linearised about braking, instant by instant; else none.

        A refused displacement may press the machine against something, and then says little about others.
        """
        if self.plant.has_acceleration or self._far:
            return super().rows()
        if self._linear is None:
            braking = self.plant.braking()
            if self._response is None or self.plant.observation_id >= self._response[1]:
                self._respond(braking)
            self._linear = self._instants(braking)
        return self._linear

    def _respond(self, control: Array) -> None:
        """How what is left at every instant changes with a control, by differences, shape (instants, n, nu)."""
        plant, horizon = self.plant, self.spec.horizon
        room = self.room(plant.forecast(control, horizon))
        step = np.where(control < 0.0, _STEP, -_STEP) * (plant.upper - plant.lower)
        changed = [self.room(plant.forecast(control + part, horizon)) for part in np.diag(step)]
        parts = [(other - room) / width for other, width in zip(changed, step, strict=True)]
        self._response = np.stack(parts, axis=-1), plant.observation_id + _KEPT

    def _instants(self, control: Array) -> HalfSpaces:
        """A row for every bound that some control could break, at a few instants of a control's forecast."""
        assert self._response is not None  # `rows` is asked first
        plant, horizon = self.plant, self.spec.horizon
        left = self.room(plant.forecast(control, horizon)) - self.spec.margin - self._outside
        left[-1] += self._outside - self._closer()
        each = len(left) // horizon
        chosen = [i for i in range(len(left)) if i % each + 1 in (*_INSTANTS, each)]
        left, response = left[chosen], self._response[0][chosen]
        away = np.where(response > 0.0, plant.lower - control, plant.upper - control)
        least = left + (response * away).sum(axis=-1)
        near = ~(least > 0.0)
        left -= _RESOLUTION * (np.abs(response) * (0.5 * (plant.upper - plant.lower))).sum(axis=-1)
        return tangent_rows(left[near], control, response[near])
