"""Admission of chunks of position setpoints: is the end within reach in time?"""

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array
from safe_wrappers.control.watchdog.reachability import (
    MotionLimits,
    admits,
    jerk_limited_time,
)
from safe_wrappers.errors import ConfigurationError, UnknownNameError, UnsupportedEnvError
from safe_wrappers.plants.mujoco.binding import actions_are_controls
from safe_wrappers.plants.mujoco.model import control_range
from safe_wrappers.wrappers.layer import Env

Measured = Callable[[Env], tuple[ArrayLike, ...]]
"""Takes the env; returns what the actions are setpoints of, velocities and, if known, accelerations, shapes (m,)."""
_MEASURED = "a function of the env that returns positions (of which actions are setpoints), velocities"


class Admission:
    """Refuses chunks that no motion within the limits could follow to their end; a necessary condition only.

    With arrival "moving" the end may be passed at any speed; with "rest" the machine must be able to stand there in
    time. `measured` None reads the lengths and velocities of the MuJoCo actuators; `controls` is m.
    """

    def __init__(self, env: Env, motion_limits: Any, measured: Measured | None, controls: int) -> None:
        if measured is None and not hasattr(env.unwrapped, "data"):
            raise UnsupportedEnvError(f"no position known: pass measured, {_MEASURED}")
        model: Any = getattr(env.unwrapped, "model", None)
        reads_actuators = measured is None and isinstance(model, mujoco.MjModel)
        if reads_actuators and not actions_are_controls(env.action_space, *control_range(model)):
            wanted = (
                "actions are in other units than the lengths of the actuators, so that these are no setpoints"
            )
            raise ConfigurationError(f"{wanted}: pass measured, {_MEASURED}")
        try:
            given = dict(motion_limits)
            arrival = given.pop("arrival", "moving")
            self._limits = MotionLimits(**given)
            np.broadcast_to(np.broadcast_arrays(*self._limits.arrays)[0], (controls,))
        except (TypeError, ValueError) as error:
            if isinstance(error, ConfigurationError):
                raise
            wanted = f"each a number or one for each of the {controls} action components"
            raise ConfigurationError(
                'motion_limits is {"max_acceleration": ..., "max_speed": ..., "max_jerk": ..., "arrival": ...}, '
                f"{wanted}; got {motion_limits!r}"
            ) from None
        if arrival not in ("moving", "rest"):
            raise UnknownNameError(f"arrival is 'moving' or 'rest', got {arrival!r}")
        self._rest = arrival == "rest"
        self._needs_acceleration = self._rest and bool(np.isfinite(self._limits.arrays[2]).any())
        if self._needs_acceleration and measured is None:
            raise ConfigurationError(f"arrival at rest: pass measured, {_MEASURED}, accelerations")
        self._env, self._measured = env, measured

    def admits(self, end: Array, duration_s: float) -> bool:
        """Whether a chunk may be executed that ends with a command (m,) after so many seconds."""
        position, velocity, acceleration = self._state()
        a_max, v_max, jerk = self._limits.arrays
        if not self._rest:
            return bool(admits(end, position, velocity, duration_s, v_max, a_max, jerk, acceleration).all())
        here = 0.0 if acceleration is None else acceleration
        least_s = jerk_limited_time((position, velocity, here), (end, 0.0, 0.0), self._limits)
        return least_s <= duration_s

    def _state(self) -> tuple[ArrayLike, ArrayLike, ArrayLike | None]:
        if self._measured is None:
            data: Any = getattr(self._env.unwrapped, "data")  # noqa: B009
            return data.actuator_length, data.actuator_velocity, None
        state = self._measured(self._env)
        if len(state) != 3 and (len(state) != 2 or self._needs_acceleration):
            wanted = _MEASURED + (", accelerations" if self._needs_acceleration else "")
            raise ConfigurationError(f"measured is {wanted}; got {len(state)} values")
        return state[0], state[1], state[2] if len(state) == 3 else None
