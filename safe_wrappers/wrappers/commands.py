"""What decides between a command and the fallback: `CommandGate` and `FallbackController`."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safe_wrappers import info as keys
from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.bound import Bound
from safe_wrappers.filter.constraint import Constraint
from safe_wrappers.filter.fallback import Fallback, FallbackFunction
from safe_wrappers.plants import default_plant
from safe_wrappers.plants.env_checks import check_actions, check_timing
from safe_wrappers.plants.plant import Plant
from safe_wrappers.wrappers.cbf_action_filter import filter_inside
from safe_wrappers.wrappers.layer import SAME_STEP, CommandReceiver, Env, LayerWrapper, Step


class FallbackController:
    """A fallback ("brake", "hold", "zero" or a function of the plant) with the plant that it needs, bound to an env.

    `plant` None reads the env's MuJoCo model where the choice needs one. A constraint is bound here; "brake" is then
    its backup control, if it has one.
    """

    def __init__(
        self,
        env: Env,
        choice: str | FallbackFunction,
        plant: Plant | None,
        constraint: Constraint | None = None,
    ) -> None:
        space: Any = env.action_space
        self._low, self._high = np.asarray(space.low, np.float64), np.asarray(space.high, np.float64)
        if plant is None and (callable(choice) or choice == "brake"):
            plant = default_plant(env)
        self.plant, self.constraint = plant, None
        if plant is not None:
            plant.bind(env)
            self.constraint = None if constraint is None else Bound(constraint, plant)
            known = self.constraint is not None and self.constraint.may_back_up
            if choice == "brake" and not (known or plant.can_brake):
                others = f'with a {type(plant).__name__} choose "hold", "zero" or a function of the plant'
                raise ConfigurationError(f'"brake" needs a MujocoPlant; {others}')
        self._fallback = Fallback(choice, [] if self.constraint is None else [self.constraint])
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
            if readable and self.constraint is not None:
                self.constraint.observe({})
        return self._fallback(self.plant, self._last, self._low, self._high, None, readable)


class CommandGate(LayerWrapper, CommandReceiver):
    """Base of `LeaseExpiry` and `TeleopChannel`; the env has a one-dimensional Box action space."""

    _fallback: FallbackController | None

    def __init__(self, env: Env, control_dt: float | None) -> None:
        LayerWrapper.__init__(self, env)
        space = check_actions(env)
        self.control_dt = check_timing(env, control_dt)
        self._same_s = SAME_STEP * self.control_dt
        self._shape, self._dtype = space.shape, space.dtype
        self._low, self._high = (np.nan_to_num(end).astype(np.float64) for end in (space.low, space.high))
        self._filtered = filter_inside(env) is not None  # then the filter reports what was executed

    def _start(self, info: dict[str, Any]) -> None:
        """Begin an episode, in which nothing has been executed yet."""
        self._steps_done = 0
        self._observed_s = 0.0
        self._clipped = 0.0
        if not self._filtered:
            info[keys.EXECUTED_ACTION] = np.zeros(self._shape)
            info[keys.ACTION_CLIPPED] = 0.0

    def _boxed(self, control: Any) -> Array:
        """Clipped to the action box, shape (m,)."""
        return np.clip(np.asarray(control, dtype=np.float64), self._low, self._high)

    def _rest(self) -> NDArray[Any]:
        """Zero, or the action in the box that is closest to it."""
        return self._boxed(np.zeros(self._shape)).astype(self._dtype)

    def _is_finite(self, action: NDArray[Any], whose: str, consequence: str) -> bool:
        """Whether an action is finite; the first one that is not is warned of."""
        finite = bool(np.isfinite(action).all())
        if not finite:
            self._warn_once("nonfinite", f"the {whose} action is not finite ({action}); {consequence}")
        return finite

    def _inside(self, action: NDArray[Any], whose: str) -> NDArray[Any]:
        """The action itself, or clipped to the space where no filter inside does that; the first one is warned of."""
        self._clipped = 0.0
        if self._filtered or not np.isfinite(action).all():
            return action
        boxed = self._boxed(action)
        self._clipped = math.hypot(*(boxed - action).ravel())  # 1e300 does not overflow in it
        if not self._clipped:
            return action
        message = f"the {whose} action left the action space by {self._clipped:.3g}; it is clipped"
        self._warn_once("outside", f"{message} (action/clipped)")
        return boxed.astype(self._dtype)

    def _execute(self, command: NDArray[Any]) -> tuple[Array, Step]:
        """Step the env; returns what was executed, which a filter inside may have changed, and the env's answer."""
        # Before the step: an env may scale the command in place.
        executed = np.array(command, dtype=np.float64)
        answer = self.env.step(command)
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
