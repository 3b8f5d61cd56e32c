"""Jitter: commands take their time, each another."""

from typing import Any

import gymnasium as gym

from safe_wrappers.filter.constraint import positive
from safe_wrappers.wrappers.faults.fault import Carried, Fault


class Jitter(Fault):
    """Delays every command by a random time, uniform from 0 to the longest, each by itself.

    At every step the newest command arrives that is there and newer than all that came before; if there is none,
    nothing arrives. So commands that were overtaken are lost.

    Args:
        env: See `Fault`.
        longest_s: s.
        hold_s: See `Fault`.
    """

    def __init__(self, env: gym.Env[Any, Any], longest_s: float, hold_s: float | None = None) -> None:
        longest_s = positive("longest_s", longest_s, "s")
        gym.utils.RecordConstructorArgs.__init__(self, longest_s=longest_s, hold_s=hold_s)
        Fault.__init__(self, env, hold_s)
        self._longest_s = longest_s

    def begin(self) -> None:
        """Nothing is on its way."""
        self._coming: list[tuple[float, Carried]] = []

    def carry(self, given: Carried | None, now_s: float) -> Carried | None:
        """The newest command that is there."""
        if given is not None:
            self._coming.append((now_s + self.random.draw.uniform(0.0, self._longest_s), given))
        there = [command for due_s, command in self._coming if due_s <= now_s]
        if not there:
            return None
        newest = max(there, key=lambda command: command.observed_s)
        self._coming = [(due, c) for due, c in self._coming if c.observed_s > newest.observed_s]
        return newest
