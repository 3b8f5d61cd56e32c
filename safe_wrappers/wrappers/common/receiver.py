"""CommandReceiver: a wrapper that is told how old a command is."""

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import OF_NUMBERS, numbers_of, shown
from safe_wrappers.errors import ActionError
from safe_wrappers.plants.env_checks import wrappers_of
from safe_wrappers.wrappers.common.layer import Env

SAME_STEP: Final = 1e-6
"""Control steps: times that are closer count as the same."""


def whole_steps(time_s: float, control_dt: float) -> int:
    """Control steps that cover a time, rounded up."""
    return math.ceil(time_s / control_dt - SAME_STEP)


class CommandReceiver:
    """Base of `ChunkHandover`, `LeaseExpiry`, `TeleopChannel` and the faults.

    What carries actions (a fault, a queue, a network) calls `set_observation_time` before `step`; without a call
    the action was made from the newest observation.
    """

    control_dt: float
    """Control interval, s."""
    _steps_done: int
    _observed_s: float | None

    @property
    def now_s(self) -> float:
        """Seconds of the episode so far, on the clock of control steps."""
        return self._steps_done * self.control_dt

    def set_observation_time(self, observed_s: float | None) -> None:
        """Say which observation the next action is made from.

        Args:
            observed_s: When that observation was returned, s on the clock of `now_s`. None: no action arrives, the
                next step's is disregarded.

        Raises:
            ActionError: Not a finite time.
        """
        given = None if observed_s is None else numbers_of(observed_s)
        if observed_s is not None and (given is None or given.ndim or not np.isfinite(given)):
            raise ActionError(
                f"observed_s is a time in seconds, or None for nothing; got {shown(observed_s)}"
            )
        self._observed_s = observed_s

    def admits(self, end: NDArray[np.float64], steps: int) -> bool:
        """Whether a chunk may be executed that ends with this command, shape (m,), so many control steps from now."""
        return True

    def admits_chunk(self, commands: NDArray[np.float64]) -> bool:
        """Whether a chunk may be executed, shape (h, m): the commands of the next h control steps."""
        return self.admits(commands[-1], len(commands))


def receiver_inside(env: Env) -> CommandReceiver | None:
    """The outermost receiver among an env's wrappers."""
    return next((inner for inner in wrappers_of(env) if isinstance(inner, CommandReceiver)), None)


def outside(action: NDArray[Any], low: NDArray[Any], high: NDArray[Any]) -> float:
    """The L2 norm by which an action (m,) left its box, of a chunk (h, m) the largest; NaN and inf count as 0."""
    if ((action >= low) & (action <= high)).all():
        return 0.0
    beyond = np.where(np.isfinite(action), action - np.clip(action, low, high), 0.0)
    return max(math.hypot(*one) for one in np.atleast_2d(beyond).tolist())  # squares may overflow


def action_array(action: Any, shape: tuple[int, ...], dtype: type | None = None) -> NDArray[Any]:
    """A copy of an action, in its own dtype unless told; an `ActionError` for another shape or no numbers."""
    given = numbers_of(action)
    if given is None:
        raise ActionError(f"expected an action of shape {shape}, {OF_NUMBERS}, got {shown(action)}")
    if given.shape != shape:
        raise ActionError(f"expected an action of shape {shape}, got shape {given.shape}")
    return given if dtype is None else given.astype(dtype, copy=False)
