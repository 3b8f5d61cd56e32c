"""FrozenPolicy: for a while the policy sends the same command again and again."""

from typing import Any

import gymnasium as gym

from safe_wrappers.wrappers.faults.fault import Carried, Fault
from safe_wrappers.wrappers.faults.spells import Spells


class FrozenPolicy(Fault):
    """Repeats, during spells of random length, the last command from before: a heartbeat with nobody behind it.

    Its stamp stays the old one: a command is as old as what it was made from, however often it is sent.

    Args:
        env: See `Fault`.
        mean_between_s: Mean time from the end of a spell to the start of the next, s.
        mean_length_s: Mean length of a spell, s.
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
        """An episode begins alive."""
        self._spells.begin(self.random)
        self._frozen: Carried | None = None

    def carry(self, given: Carried | None, now_s: float) -> Carried | None:
        """The command, or the one from before the spell."""
        if self._spells.bad(now_s, self.random):
            return self._frozen
        self._frozen = given if given is not None else self._frozen
        return given
