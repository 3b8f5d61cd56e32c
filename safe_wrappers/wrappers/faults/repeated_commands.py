"""RepeatedCommands: now and then the command, or chunk, from before is sent again instead of the new one."""

from typing import Any

import gymnasium as gym

from safe_wrappers.wrappers.faults.fault import Carried, Fault
from safe_wrappers.wrappers.faults.parameters import probability


class RepeatedCommands(Fault):
    """Sends the command that arrived last once more, with its old stamp, and loses the new one.

    Args:
        env: See `Fault`.
        share: Probability that a command is replaced by the one before, from 0 to 1.
        hold_s: See `Fault`.
    """

    def __init__(self, env: gym.Env[Any, Any], share: float, hold_s: float | None = None) -> None:
        share = probability("share", share)
        gym.utils.RecordConstructorArgs.__init__(self, share=share, hold_s=hold_s)
        Fault.__init__(self, env, hold_s)
        self._share = share

    def begin(self) -> None:
        """Nothing has arrived that could be repeated."""
        self._before: Carried | None = None

    def carry(self, given: Carried | None, now_s: float) -> Carried | None:
        """The command, or the one before."""
        if self.random.draw.random() >= self._share:
            self._before = given if given is not None else self._before
            return given
        return self._before
