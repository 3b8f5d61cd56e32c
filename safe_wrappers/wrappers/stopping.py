"""What a stop inside a clearance takes, and what decides between a command and the fallback."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers import info as keys
from safe_wrappers.constraints.clearance import Clearance
from safe_wrappers.control.watchdog import longest_lease
from safe_wrappers.errors import Array, ConfigurationError, check_fields, non_negative, positive
from safe_wrappers.filter.bound import Bound
from safe_wrappers.filter.constraint import Constraint
from safe_wrappers.filter.fallback import Fallback, FallbackFunction
from safe_wrappers.plants import default_plant
from safe_wrappers.plants.env_checks import check_actions, check_timing
from safe_wrappers.plants.plant import Plant
from safe_wrappers.wrappers.cbf_action_filter import filter_inside
from safe_wrappers.wrappers.layer import SAME_STEP, CommandReceiver, Env, LayerWrapper, Step
from safe_wrappers.wrappers.serialize import constraint_from

ClearanceFunction = Callable[[Env], tuple[ArrayLike, ArrayLike]]
"""Takes the env; returns clearances (m) and the approach speeds towards them (m/s), shapes (k,)."""

_AT_ONCE: Final = 1e300
"""m/s^2; the braking of a value that counts the stopping distance already: it takes no way."""
_ROW_TOLERANCE = 1e-9
"""Control units times normals: a row that is violated by less is kept."""


@dataclass(frozen=True)
class StoppingBudget:
    """Clearance, bounds on the motion and delays from which a stop is worked out; shared by lease and ceiling.

    Args:
        clearance: A `Clearance` or the dict of one; any other constraint, with `closing_speed`; or a function of the
            env that returns clearances in m, less all reserves, and approach speeds in m/s, shapes (k,).
        braking: For a function: verified lower bound on the deceleration of the fallback, m/s^2. A `Clearance` has
            its own, and its own margin and state error.
        acceleration: Largest approach acceleration that any command may cause, the fallback's too, m/s^2; 0 for a
            machine that cruises.
        closing_speed: For constraints other than Clearance: the fastest that their value may fall, in its unit per
            second, stopping distance and all, under any command.
        top_speed: Bound on the approach speed, m/s; None: none.
        delays_s: T_detect + T_hold + t_age + T_act, s: how old a clearance is when it is read, how long the end of a
            lease takes to be noticed and confirmed, and how long until the full deceleration is there.

    Raises:
        ConfigurationError: A bound that is missing, negative or does not belong to the clearance.
    """

    clearance: Constraint | dict[str, Any] | ClearanceFunction
    braking: float | None = None
    acceleration: float | None = None
    closing_speed: float | None = None
    top_speed: float | None = None
    delays_s: float = 0.0

    def __post_init__(self) -> None:
        given: Any = self.clearance
        if isinstance(given, dict | Constraint):
            object.__setattr__(self, "clearance", constraint_from(given))
        elif isinstance(given, type) or not callable(given):
            raise ConfigurationError(
                "clearance is a constraint, or a function of the env that returns clearances in m and approach "
                f"speeds in m/s; got {given!r}"
            )
        check_fields(self, non_negative, ["delays_s"], "s")
        check_fields(self, non_negative, ["acceleration"], "m/s^2")
        check_fields(self, positive, ["braking"], "m/s^2")
        check_fields(self, positive, ["top_speed"], "m/s")
        check_fields(self, positive, ["closing_speed"], "the constraint's unit per second")
        takes, more = {"closing_speed"}, set()
        if self.measures_approach:
            takes, more = {"acceleration"}, {"top_speed"}
            if not isinstance(self.clearance, Clearance):
                takes.add("braking")
        bounds = ("braking", "acceleration", "closing_speed", "top_speed")
        found = {name for name in bounds if getattr(self, name) is not None}
        if not takes <= found <= takes | more:
            kind, needed = type(self.clearance).__name__, " and ".join(sorted(takes))
            optional = ", and maybe top_speed" if more else ""
            raise ConfigurationError(f"a budget by a {kind} takes {needed}{optional}; got {sorted(found)}")

    @property
    def measures_approach(self) -> bool:
        """Whether approach speeds are measured, and not only bounded by `closing_speed`."""
        return not isinstance(self.clearance, Constraint) or isinstance(self.clearance, Clearance)


def bound_plant(
    env: Env, plant: Plant | None, fallback: str | FallbackFunction, clearance: Any = None
) -> Plant | None:
    """The plant given, else the default one where fallback or clearance need one, bound to the env."""
    if plant is None and (callable(fallback) or fallback == "brake" or isinstance(clearance, Constraint)):
        plant = default_plant(env)
    if plant is not None:
        plant.bind(env)
    return plant


class BoundBudget:
    """A budget that measures an env, on a `bound_plant` if its clearance is a constraint.

    Attributes:
        clearance: At the last `measure`, m, shape (k,); of a constraint that measures no approach, its room.
        speed: Approach speeds then, m/s, shape (k,); `closing_speed` of a constraint that measures none.
    """

    def __init__(self, budget: StoppingBudget, env: Env, plant: Plant | None) -> None:
        self._budget, self._env = budget, env
        given: Any = budget.clearance
        self.bound: Bound | None = None
        self._stop: Any = {"braking": _AT_ONCE if budget.braking is None else budget.braking}
        if isinstance(given, Constraint):
            assert plant is not None
            self.bound = Bound(given, plant)
            if not self.bound.measures_state:
                name = type(given).__name__
                raise ConfigurationError(f"{name} has no value that a lease could be worked out from")
        if isinstance(given, Clearance):
            own = {"localisation": given.state_error, "margin": given.margin, "braking": float(given.braking)}
            self._stop.update(own)

    def observe(self) -> None:
        """Take the present state; the constraint refuses what only a state can show."""
        if self.bound is not None:
            self.bound.plant.observe()
            self.bound.observe({})

    def measure(self) -> None:
        """Read clearances and approach speeds of the present state."""
        if self.bound is None:
            function: Any = self._budget.clearance
            answer = (np.atleast_1d(np.asarray(x, dtype=np.float64)) for x in function(self._env))
            self.clearance, self.speed = np.broadcast_arrays(*answer)
            return
        self.observe()
        if not np.isfinite(self.bound.plant.state).all():  # of which it may read only a part
            self.clearance = self.speed = np.full(1, np.nan)
        elif isinstance(self.bound.spec, Clearance):
            self.clearance, self.speed = self.bound.spec.approach()
        else:
            value = np.asarray(self.bound.value(), dtype=np.float64)
            self.clearance = value[value != np.inf] - self.bound.spec.margin
            self.speed = np.full(self.clearance.shape, self._budget.closing_speed)

    @property
    def readable(self) -> bool:
        """Whether all that was measured is finite."""
        return bool(np.isfinite(self.clearance).all() and np.isfinite(self.speed).all())

    def longest_time(self, delays_s: float = 0.0) -> float:
        """The longest time that the worst command may go on from the measured state, s; zero or less: stop now.

        NaN where the measurement is not finite; inf without obstacles near. `delays_s` are more than the budget's, s.
        """
        if not self.readable:
            return math.nan
        budget = self._budget
        top_speed = math.inf if budget.top_speed is None else budget.top_speed
        acceleration = 0.0 if budget.acceleration is None else budget.acceleration
        bounds: Any = {"acceleration": acceleration, "top_speed": top_speed, **self._stop}
        times = longest_lease(self.clearance, self.speed, delays_s=delays_s + budget.delays_s, **bounds)
        return float(times.min(initial=np.inf))

    def longest_round_trip(self, operator_s: float) -> float:
        """The longest round trip from which an operator can stop in time, s; inf where nothing approaches.

        `operator_s` is T_video + T_human, s.
        """
        delays_s = operator_s + self._budget.delays_s
        ceilings = longest_lease(self.clearance, self.speed, delays_s=delays_s, **self._stop)
        return float(ceilings[self.speed > 0.0].min(initial=math.inf))

    def can_stop_after(self, command: Array, duration_s: float) -> bool:
        """Whether the machine can stop by itself after a command of so many seconds.

        By the declared bounds, whatever the command is, or by the rows of a `Clearance` (without `delays_s`).
        """
        if self.longest_time() >= duration_s:
            return True
        by_rows = self.bound is not None and isinstance(self.bound.spec, Clearance)
        if not (by_rows and self._budget.delays_s == 0.0 and self.readable):
            return False
        assert self.bound is not None
        rows = self.bound.rows()
        return bool((rows.normals @ command <= rows.offsets + _ROW_TOLERANCE).all())


class FallbackController:
    """A fallback ("brake", "hold", "zero" or a function of the plant) on a `bound_plant`, by itself.

    "brake" is the backup control of the constraint, if one is given and has one.
    """

    def __init__(
        self, env: Env, choice: str | FallbackFunction, plant: Plant | None, bound: Bound | None = None
    ) -> None:
        space: Any = env.action_space
        self._low, self._high = np.asarray(space.low, np.float64), np.asarray(space.high, np.float64)
        self.plant, self._bound = plant, bound
        known = bound is not None and bound.may_back_up
        if choice == "brake" and plant is not None and not (known or plant.can_brake):
            raise ConfigurationError(
                '"brake" needs a MujocoPlant; choose "hold", "zero" or a function of the plant'
            )
        self._fallback = Fallback(choice, [] if bound is None else [bound])
        self.reset()

    def reset(self) -> None:
        """Forget the episode."""
        self._last = np.clip(np.zeros_like(self._low), self._low, self._high)
        if self.plant is not None:
            self.plant.executed(None)

    def executed(self, control: Array) -> None:
        """Keep what was sent, for "hold" and for the plant's delay."""
        self._last = control
        if self.plant is not None:
            self.plant.executed(control)

    def command(self) -> Array:
        """The fallback's control at the present state: finite, inside the action box, shape (m,)."""
        readable = True
        if self.plant is not None:
            self.plant.observe()
            readable = bool(np.isfinite(self.plant.state).all())
            if readable and self._bound is not None:
                self._bound.observe({})
        return self._fallback(self.plant, self._last, self._low, self._high, None, readable)


class CommandGate(LayerWrapper, CommandReceiver):
    """Base of `LeaseExpiry` and `TeleopChannel`; the env has a one-dimensional Box action space."""

    _fallback: FallbackController | None = None

    def __init__(self, env: Env) -> None:
        LayerWrapper.__init__(self, env)
        space = check_actions(env)
        self.control_dt = check_timing(env)
        self._same_s = SAME_STEP * self.control_dt
        self._shape, self._dtype = space.shape, space.dtype
        self._low, self._high = (np.nan_to_num(end).astype(np.float64) for end in (space.low, space.high))
        self._filtered = filter_inside(env) is not None  # then the filter reports what was executed

    def _begin(self, observation: Any, info: dict[str, Any], seed: int | None) -> Any:
        self._steps_done, self._observed_s, self._clipped = 0, 0.0, 0.0
        if self._fallback is not None:
            self._fallback.reset()
        if not self._filtered:
            info[keys.EXECUTED_ACTION] = np.zeros(self._shape)
            info[keys.ACTION_CLIPPED] = 0.0
        return observation

    def _boxed(self, control: Any) -> Array:
        """Clipped to the action box, shape (m,)."""
        return np.clip(np.asarray(control, dtype=np.float64), self._low, self._high)

    def _rest(self) -> NDArray[Any]:
        """Zero, or the action in the box that is closest to it."""
        return self._boxed(np.zeros(self._shape)).astype(self._dtype)

    def _inside(self, action: NDArray[Any]) -> NDArray[Any] | None:
        """The action itself, or clipped where no filter inside does that; None if it is not finite. It warns once."""
        self._clipped = 0.0
        if not np.isfinite(action).all():
            self._warn_once("nonfinite", f"the policy's action is not finite ({action}); it is not executed")
            return None
        if self._filtered:
            return action
        boxed = self._boxed(action)
        self._clipped = math.hypot(*(boxed - action).ravel())  # 1e300 does not overflow in it
        if not self._clipped:
            return action
        message = f"the policy's action left the action space by {self._clipped:.3g}; it is clipped"
        self._warn_once("outside", f"{message} (action/clipped)")
        return boxed.astype(self._dtype)

    def _execute(self, command: NDArray[Any]) -> tuple[Array, Step]:
        """Step the env; returns what was executed, which a filter inside may have changed, and the env's answer."""
        # Before the step: an env may scale the command in place.
        executed = np.array(command, dtype=np.float64)
        answer = self._pass_on(command)
        info = answer[4]
        if self._filtered:
            executed = np.array(info[keys.EXECUTED_ACTION], dtype=np.float64)
        else:
            info[keys.EXECUTED_ACTION] = executed.copy()
            info[keys.ACTION_CLIPPED] = self._clipped
        if self._fallback is not None:
            self._fallback.executed(executed)
        self._steps_done += 1
        return executed, answer
