"""Admission of chunks of position setpoints: is the end within reach in time?"""

import math
from typing import Any

import mujoco
import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.control.watchdog import admits, checked_limits, jerk_limited_time
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants.mujoco.binding import actions_are_controls
from safe_wrappers.plants.mujoco.model import control_range
from safe_wrappers.wrappers.layer import Env


def _limits(
    max_acceleration: Any, max_speed: Any = math.inf, arrival: str = "moving"
) -> tuple[Array, Array, bool]:
    """The limits, and whether the machine must be able to stand at the end."""
    return *checked_limits(max_acceleration, max_speed), {"moving": False, "rest": True}[arrival]


class Admission:
    """Refuses chunks that no motion within the limits could follow to their end; a necessary condition only.

    With arrival "moving" the end may be passed at any speed; with "rest" the machine must be able to stand there in
    time. Where it is, the lengths and velocities of the MuJoCo actuators say; `controls` is m.
    """

    def __init__(self, env: Env, motion_limits: Any, controls: int) -> None:
        model: Any = getattr(env.unwrapped, "model", None)
        if not isinstance(model, mujoco.MjModel):
            raise UnsupportedEnvError("motion_limits are for MuJoCo's actuators, whose lengths are read")
        if not actions_are_controls(env.action_space, *control_range(model)):
            units = "actions are in other units than the lengths of the actuators"
            raise ConfigurationError(f"motion_limits: {units}, so that these are no setpoints")
        try:
            acceleration, speed, self._rest = _limits(**motion_limits)
            self._acceleration, self._speed = (np.broadcast_to(x, (controls,)) for x in (acceleration, speed))
        except (KeyError, TypeError, ValueError) as error:
            if isinstance(error, ConfigurationError):
                raise
            wanted = f"each a number or one for each of the {controls} action components"
            raise ConfigurationError(
                'motion_limits is {"max_acceleration": ..., "max_speed": ..., "arrival": "moving" or "rest"}, '
                f"{wanted}; got {motion_limits!r}"
            ) from None
        self._raw: Any = env.unwrapped

    def admits(self, end: Array, duration_s: float) -> bool:
        """Whether a chunk may be executed that ends with a command (m,) after so many seconds."""
        position, velocity = self._raw.data.actuator_length, self._raw.data.actuator_velocity
        if self._rest:
            states = (position, velocity, 0.0), (end, 0.0, 0.0)
            return jerk_limited_time(*states, self._acceleration, self._speed) <= duration_s
        return bool(admits(end, position, velocity, duration_s, self._speed, self._acceleration).all())
