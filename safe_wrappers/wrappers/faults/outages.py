"""Outages: for a while no command arrives at all."""

from typing import Any

import gymnasium as gym

from safe_wrappers.wrappers.faults.fault import Carried, Fault
from safe_wrappers.wrappers.faults.spells import Spells


class Outages(Fault):
    """Loses all commands during outages of random length, at random times.

    Args:
        env: See `Fault`.
        mean_between_s: Mean time from the end of an outage to the start of the next, s.
        mean_length_s: Mean length of an outage, s.
        hold_s: See `Fault`.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        mean_between_s: float,
        mean_length_s: float,
        hold_s: float | None = None,
    ) -> None:
        self._spells = Spells(mean_between_s, mean_length_s)
        gym.utils.RecordConstructorArgs.__init__(
            self, mean_between_s=mean_between_s, mean_length_s=mean_length_s, hold_s=hold_s
        )
        Fault.__init__(self, env, hold_s)

    def begin(self) -> None:
        """An episode begins without an outage."""
        self._spells.begin(self.random)

    def carry(self, given: Carried | None, now_s: float) -> Carried | None:
        """The command, or nothing."""
        return None if self._spells.bad(now_s, self.random) else given
