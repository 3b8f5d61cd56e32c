"""StoppingBudget: what a stop inside a clearance takes, and how long any command may go on before it."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, check_fields, non_negative, positive, settings_from
from safe_wrappers.constraints.clearance import Clearance
from safe_wrappers.control.watchdog import longest_lease, longest_lease_of_room
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.bound import Bound
from safe_wrappers.filter.constraint import Constraint
from safe_wrappers.plants import default_plant
from safe_wrappers.plants.plant import Plant
from safe_wrappers.serialize import constraint_from
from safe_wrappers.wrappers.layer import Env

ClearanceFunction = Callable[[Env], tuple[ArrayLike, ArrayLike]]
"""Takes the env; returns clearances (m) and the approach speeds towards them (m/s), shapes (k,)."""

_ROW_TOLERANCE = 1e-9
"""Control units times normals: a row that is violated by less is kept."""


@dataclass(frozen=True)
class StoppingBudget:
    """Clearance, bounds on the motion and reserves from which a stop is worked out; shared by lease and ceiling.

    Args:
        clearance: A `Clearance` or the dict of one; any other constraint, with `closing_speed`; or a function of the
            env that returns clearances in m and approach speeds in m/s, shapes (k,).
        braking: Verified lower bound on the deceleration of the fallback, m/s^2; None takes the constraint's own.
        acceleration: Largest approach acceleration that any command may cause, the fallback's too, m/s^2; 0 for a
            machine that cruises.
        closing_speed: For constraints other than Clearance: the fastest that their value may fall, in its unit per
            second, stopping distance and all, under any command.
        top_speed: Bound on the approach speed, m/s; None: none.
        localisation: Bound on the error of the clearance, m; the constraint's own is added.
        margin: Clearance to be kept at rest, m; the constraint's own is added.
        act_s: T_act, until the full deceleration is there, s.

    Raises:
        ConfigurationError: A bound that is missing, negative or does not belong to the clearance.
    """

    clearance: Constraint | dict[str, Any] | ClearanceFunction
    braking: float | None = None
    acceleration: float | None = None
    closing_speed: float | None = None
    top_speed: float | None = None
    localisation: float = 0.0
    margin: float = 0.0
    act_s: float = 0.0

    def __post_init__(self) -> None:
        given: Any = self.clearance
        if isinstance(given, dict | Constraint):
            object.__setattr__(self, "clearance", constraint_from(given))
        elif isinstance(given, type) or not callable(given):
            function = "a function of the env that returns clearances in m and approach speeds in m/s"
            raise ConfigurationError(f"clearance is a constraint or {function}; got {given!r}")
        check_fields(self, non_negative, ["localisation", "margin"], "m")
        check_fields(self, non_negative, ["act_s"], "s")
        check_fields(self, non_negative, ["acceleration"], "m/s^2")
        check_fields(self, positive, ["braking"], "m/s^2")
        check_fields(self, positive, ["top_speed"], "m/s")
        check_fields(self, positive, ["closing_speed"], "the constraint's unit per second")
        name = type(self.clearance).__name__
        if not self.measures_approach:
            if self.closing_speed is None:
                raise ConfigurationError(f"{name} does not say how fast it is approached: give closing_speed")
            if (self.braking, self.acceleration, self.top_speed) != (None,) * 3:
                raise ConfigurationError(f"{name} counts braking already: give closing_speed alone")
            return
        if self.braking is None and not isinstance(self.clearance, Clearance):
            raise ConfigurationError("braking is missing: the least deceleration of the fallback, m/s^2")
        if self.acceleration is None:
            raise ConfigurationError("acceleration is missing: the largest that any command may cause, m/s^2")
        if self.closing_speed is not None:
            raise ConfigurationError("closing_speed is for constraints that measure no approach speed")

    @property
    def measures_approach(self) -> bool:
        """Whether approach speeds are measured, and not only bounded by `closing_speed`."""
        return not isinstance(self.clearance, Constraint) or isinstance(self.clearance, Clearance)


BudgetLike = StoppingBudget | dict[str, Any]


def budget_from(given: Any) -> StoppingBudget:
    """A budget itself, or from the dict of one."""
    return settings_from(StoppingBudget, given, "budget")


class BoundBudget:
    """A budget that measures an env."""

    clearance: Array  # at the last `measure`, m, shape (k,); values of a constraint that measures no approach
    speed: Array  # approach speeds, m/s, shape (k,)

    def __init__(self, budget: StoppingBudget, env: Env) -> None:
        self._budget, self._env = budget, env
        self._measures_approach = budget.measures_approach
        given: Any = budget.clearance
        self.constraint: Constraint | None = given if isinstance(given, Constraint) else None
        own = (0.0, 0.0) if self.constraint is None else (given.state_error, given.margin)
        localisation, margin = budget.localisation + own[0], budget.margin + own[1]
        self._reserves = {"localisation": localisation, "margin": margin}
        self._stop: dict[str, Any] = dict(self._reserves)
        if self._measures_approach:
            braking = budget.braking if budget.braking is not None else float(given.braking)
            self._stop["braking"] = braking
            if isinstance(self.constraint, Clearance):
                # Its rows are then those of this budget.
                own_bounds: Any = {"braking": braking, "margin": margin, "state_error": localisation}
                self.constraint = replace(self.constraint, **own_bounds)

    def plant_of(self, plant: Plant | None) -> Plant | None:
        """The plant given, else the env's MuJoCo model where the constraint needs one; to be bound before `bind`."""
        return default_plant(self._env) if plant is None and self.constraint is not None else plant

    def bind(self, plant: Plant | None, bound: Bound | None = None) -> None:
        """Measure on a plant that is bound to the env, and on the constraint if it is bound already."""
        self._bound = bound
        if bound is None and self.constraint is not None and plant is not None:
            self._bound = Bound(self.constraint, plant)
        if self._bound is not None and not self._bound.measures_state:
            name = type(self.constraint).__name__
            raise ConfigurationError(f"{name} has no value that a lease could be worked out from")

    def reset(self) -> None:
        """Forget the episode, and let the constraint refuse what only a state can show."""
        if self._bound is not None:
            self._observe(self._bound)

    def _observe(self, bound: Bound) -> None:
        bound.plant.observe()
        bound.observe({})

    def measure(self) -> None:
        """Read clearances and approach speeds of the present state."""
        if self._bound is None:
            self.clearance, self.speed = self._of_function()
            return
        self._observe(self._bound)
        if not np.isfinite(self._bound.plant.state).all():  # of which it may read only a part
            self.clearance = self.speed = np.full(1, np.nan)
            return
        if isinstance(self._bound.spec, Clearance):
            self.clearance, self.speed = self._bound.spec.approach()
            return
        value = np.asarray(self._bound.value(), dtype=np.float64)
        self.clearance = value[value != np.inf]
        self.speed = np.zeros(self.clearance.shape)

    @property
    def readable(self) -> bool:
        """Whether all that was measured is finite."""
        return bool(np.isfinite(self.clearance).all() and np.isfinite(self.speed).all())

    def longest_time(self, delays_s: float = 0.0) -> float:
        """The longest time that the worst command may go on from the measured state, s; zero or less: stop now.

        NaN where the measurement is not finite; inf without obstacles near. `delays_s` are all delays but `act_s`, s.
        """
        if not self.readable:
            return math.nan
        budget, delays_s = self._budget, delays_s + self._budget.act_s
        if self._measures_approach:
            top_speed = math.inf if budget.top_speed is None else budget.top_speed
            bounds: dict[str, Any] = {"acceleration": budget.acceleration, "top_speed": top_speed}
            times = longest_lease(self.clearance, self.speed, delays_s=delays_s, **self._stop, **bounds)
        else:
            assert budget.closing_speed is not None
            left = self.clearance - self._reserves["margin"] - self._reserves["localisation"]
            times = longest_lease_of_room(left, budget.closing_speed, delays_s)
        return float(times.min(initial=np.inf))

    def longest_round_trip(self, video_s: float, human_s: float) -> float:
        """The longest round trip from which an operator can stop in time, s; inf where nothing approaches."""
        delays_s = video_s + human_s + self._budget.act_s
        ceilings = longest_lease(self.clearance, self.speed, delays_s=delays_s, **self._stop)
        return float(ceilings[self.speed > 0.0].min(initial=math.inf))

    def can_stop_after(self, command: Array, duration_s: float) -> bool:
        """Whether the machine can stop by itself after a command of so many seconds.

        By the declared bounds, whatever the command is, or by the rows of a `Clearance` (without `act_s`).
        """
        if self.longest_time() >= duration_s:
            return True
        if not (isinstance(self.constraint, Clearance) and self._budget.act_s == 0.0 and self.readable):
            return False
        assert self._bound is not None
        rows = self._bound.rows()
        return bool((rows.normals @ command <= rows.offsets + _ROW_TOLERANCE).all())

    def _of_function(self) -> tuple[Array, Array]:
        function: Any = self._budget.clearance
        answer = function(self._env)
        try:
            clearance, speed = (np.atleast_1d(np.asarray(x, dtype=np.float64)) for x in answer)
            clearance, speed = np.broadcast_arrays(clearance, speed)
        except (TypeError, ValueError):
            wanted = "clearances in m and approach speeds in m/s, of one shape"
            raise ConfigurationError(f"the clearance function must return {wanted}; got {answer!r}") from None
        return clearance, speed
