"""What constraints share that are judged on a forecast of the machine instead of on rows."""

import warnings
from abc import ABC, abstractmethod
from collections import deque
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.filter.constraint import HalfSpaces, positive
from safe_wrappers.filter.linearize import cut, through
from safe_wrappers.plants.mujoco.forecast import Forecast
from safe_wrappers.plants.mujoco.plant import MujocoPlant
from safe_wrappers.plants.plant import Plant

Array = NDArray[np.float64]

_ROUNDING = 1e-9
_STEP = 1e-4
"""Width of the differences about braking, as a share of the control's range."""
_INSTANTS = (1, 2, 3, 5, 8, 13, 21, 34, 55)
"""Instants of a control interval that rows are made of, beside its last; forecasts are judged at all of them."""
_KEPT = 10
"""Control steps for which a response is kept: it is a guess that forecasts check, and differences cost one each."""
_SAME_RESPONSE = 1
"""Cuts of one step that take the kept response for theirs."""
_RESOLUTION = 1e-6
"""Of controls, as a share of half their range: aimed farther inward by what rounding them may change."""
RECOVERY_S = 0.1
"""Time constant, s, in which a state outside has to come back."""


class Predicted(ABC):
    """A requirement `room >= margin` along a forecast: the held control first, braking after it.

    A subclass says what is left of its limit at the present state (`value`) and along a forecast (`_room`).
    This class decides from it (`admits`), linearises about a refused control (`cut`) and says by how much a
    control fails (`shortfall`).

    A forecast costs at least what a step of the env costs. So `reach` may declare how far `value` can fall at most
    within the forecast, whatever the controls do: a state with more than that left is admitted without one. The
    declaration is checked at every step, and dropped with a warning when broken.

    Attributes of a subclass (dataclass fields): `margin` (units of the value), `holds` (control intervals to
    look ahead), `reach` (units of the value, or None: always forecast).
    """

    margin: float
    holds: int
    reach: float | None
    unit: ClassVar[str] = "units of the value"

    @property
    def scale(self) -> float:
        """What a shortfall is compared with, where constraints of several units fail at once."""
        return 1.0

    def _check_shared(self) -> None:
        whole = isinstance(self.holds, int | float | np.number) and not isinstance(self.holds, bool)
        if not (whole and np.isfinite(self.holds) and self.holds == int(self.holds) and self.holds >= 1):
            raise ConfigurationError(
                f"holds is a whole number of control intervals to look ahead, >= 1; got {self.holds!r}"
            )
        self.holds = int(self.holds)
        if self.reach is not None:
            self.reach = positive("reach", self.reach, self.unit)

    @abstractmethod
    def _room(self, plant: MujocoPlant, forecast: Forecast) -> Array:
        """What is left of the limit along a forecast, in time: shape (instants, n)."""

    @abstractmethod
    def _now(self, plant: MujocoPlant) -> Array:
        """What is left of the limit at the present state, shape (n,)."""

    def bind(self, plant: Plant) -> None:
        """Refuse a plant without a model to forecast with."""
        if not isinstance(plant, MujocoPlant):
            raise UnsupportedEnvError(
                f"{type(self).__name__} forecasts with a MuJoCo model; on an AnalyticPlant use "
                "Barrier(h) or Clearance(...)"
            )
        self._stamp: int | None = None
        self._response: Array | None = None
        self._recent: deque[float] = deque(maxlen=self.holds)
        self._reach = self.reach

    def reset(self) -> None:
        """Forget the episode."""
        self._stamp = None
        self._response = None
        self._recent.clear()

    def value(self, plant: MujocoPlant) -> Array:
        """What is left of the limit at the present state, margin not taken off."""
        self._look(plant)
        return self._value

    def _look(self, plant: MujocoPlant) -> None:
        if self._stamp == plant.stamp:
            return
        self._value = self._now(plant)
        self._linear: HalfSpaces | None = None
        self._cuts = 0
        self._least = float(self._value.min(initial=np.inf))
        self._stamp = plant.stamp
        if self._reach is not None:
            self._check_reach(self._reach)
        self._outside = self._violation(self._value)
        self._far = self._reach is not None and self._least - self._reach >= self.margin + _ROUNDING

    def _check_reach(self, reach: float) -> None:
        fallen = max(self._recent, default=-np.inf) - self._least
        if fallen > reach + _ROUNDING:
            warnings.warn(
                f"{type(self).__name__}: what is left of the limit fell by {fallen:.3g} {self.unit} within "
                f"{len(self._recent)} control steps, farther than the declared reach of {reach:g}; from now on every "
                "control is forecast",
                stacklevel=2,
            )
            self._reach = None
        self._recent.append(self._least)

    def _violation(self, value: Array) -> Array:
        """The present violations that a forecast starts from, <= 0, shape (n,)."""
        return np.minimum(value - self.margin, 0.0)

    def slacks(self, plant: MujocoPlant, control: Array) -> Array:
        """What is left of what is asked for along the forecast of a control, shape (k,); wanted >= 0."""
        self._look(plant)
        left = self._room(plant, plant.forecast(control, self.holds)) - self.margin
        if not self._outside.any():
            return np.asarray(left.min(axis=0))
        # From outside, bound by bound: no farther out on the way, and closer at the end.
        return np.concatenate([left.min(axis=0) - self._outside, left[-1] - self._closer(plant)])

    def _closer(self, plant: MujocoPlant) -> Array:
        """What is left of the present violations at the end of a forecast, <= 0, shape (n,)."""
        return np.asarray(self._outside * np.exp(-self.holds * plant.hold_s / RECOVERY_S))

    def admits(self, plant: MujocoPlant, control: Array) -> bool:
        """Whether the forecast keeps the margin (from outside: whether it comes back towards it)."""
        self._look(plant)
        return self._far or self.shortfall(plant, control) <= _ROUNDING

    def shortfall(self, plant: MujocoPlant, control: Array) -> float:
        """By how much the forecast of a control misses what is asked for, in the value's units; <= 0: not at all."""
        least = float(self.slacks(plant, control).min(initial=np.inf))
        return -least if least == least else np.inf

    def cut(self, plant: MujocoPlant, control: Array) -> HalfSpaces:
        """The forecast, linearised about a refused control."""
        if plant.has_acceleration:
            return cut(lambda u: self.slacks(plant, u), control, plant.lower, plant.upper)
        self._cuts += 1
        if self._cuts > _SAME_RESPONSE:
            self._respond(plant, control)
        return self._instants(plant, control)

    def rows(self, plant: Any) -> HalfSpaces:
        """None: what counts is the forecast, linearised where a control has been refused.

        Where controls are no forces: the forecast linearised about braking, instant by instant. A displacement that
        is refused may press the machine against something, and says little about one that does not.
        """
        if plant.has_acceleration:
            return HalfSpaces.none(plant.lower.size)
        self._look(plant)
        if self._far:
            return HalfSpaces.none(plant.lower.size)
        if self._linear is None:
            braking = plant.braking()
            if self._response is None or plant.stamp >= self._response_until:
                self._respond(plant, braking)
            self._linear = self._instants(plant, braking)
        return self._linear

    def _respond(self, plant: MujocoPlant, control: Array) -> None:
        """How what is left at every instant changes with a control, by differences, shape (instants, n, nu)."""
        room = self._room(plant, plant.forecast(control, self.holds))
        step = np.where(control < 0.0, _STEP, -_STEP) * (plant.upper - plant.lower)
        changed = [self._room(plant, plant.forecast(control + part, self.holds)) for part in np.diag(step)]
        parts = [(other - room) / width for other, width in zip(changed, step, strict=True)]
        self._response, self._response_until = np.stack(parts, axis=-1), plant.stamp + _KEPT

    def _instants(self, plant: MujocoPlant, control: Array) -> HalfSpaces:
        """A row for every bound that some control could break, at a few instants of a control's forecast."""
        assert self._response is not None  # `rows` is asked first
        left = self._room(plant, plant.forecast(control, self.holds)) - self.margin - self._outside
        left[-1] += self._outside - self._closer(plant)
        each = len(left) // self.holds
        chosen = [i for i in range(len(left)) if i % each + 1 in (*_INSTANTS, each)]
        left, response = left[chosen], self._response[chosen]
        away = np.where(response > 0.0, plant.lower - control, plant.upper - control)
        least = left + (response * away).sum(axis=-1)
        near = ~(least > 0.0)
        left -= _RESOLUTION * (np.abs(response) * (0.5 * (plant.upper - plant.lower))).sum(axis=-1)
        return through(left[near], control, response[near])
