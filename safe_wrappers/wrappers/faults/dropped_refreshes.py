"""DroppedRefreshes: commands are lost, each by itself."""

from typing import Any

import gymnasium as gym

from safe_wrappers.wrappers.faults.fault import Carried, Fault
from safe_wrappers.wrappers.faults.parameters import probability


class DroppedRefreshes(Fault):
    """Loses every command with the same probability, independently of the others.

    Args:
        env: See `Fault`.
        share: Probability that a command is lost, from 0 to 1.
        hold_s: See `Fault`.
    """

    def __init__(self, env: gym.Env[Any, Any], share: float, hold_s: float | None = None) -> None:
        share = probability("share", share)
        gym.utils.RecordConstructorArgs.__init__(self, share=share, hold_s=hold_s)
        Fault.__init__(self, env, hold_s)
        self._share = share

    def carry(self, given: Carried | None, now_s: float) -> Carried | None:
        """The command, or nothing."""
        return None if self.random.draw.random() < self._share else given
