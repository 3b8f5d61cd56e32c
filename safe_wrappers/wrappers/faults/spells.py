"""Spells: a process that is well for a while, then not, then well again."""

from typing import Any

import gymnasium as gym

from safe_wrappers.filter.constraint import positive
from safe_wrappers.wrappers.common.wrapper_rng import OwnRandom
from safe_wrappers.wrappers.faults.fault import Fault


class Spells:
    """Bad spells of random, exponentially distributed length, at random, exponentially distributed intervals.

    Args:
        mean_between_s: Mean time from the end of one to the start of the next, s.
        mean_length_s: Mean length, s.
    """

    def __init__(self, mean_between_s: float, mean_length_s: float) -> None:
        self._between = positive("mean_between_s", mean_between_s, "s")
        self._length = positive("mean_length_s", mean_length_s, "s")

    def begin(self, random: OwnRandom) -> None:
        """A new episode, which begins well."""
        self._bad = False
        self._until_s = random.draw.exponential(self._between)

    def bad(self, now_s: float, random: OwnRandom) -> bool:
        """Whether it is a bad spell now; times must not run backwards."""
        while now_s >= self._until_s:
            self._bad = not self._bad
            self._until_s += random.draw.exponential(self._length if self._bad else self._between)
        return self._bad


class SpellFault(Fault):
    """A fault that comes in spells.

    Args:
        env: See `Fault`.
        mean_between_s: See `Spells`.
        mean_length_s: See `Spells`.
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
        """An episode begins well."""
        self._spells.begin(self.random)

    def bad(self, now_s: float) -> bool:
        """Whether it is a bad spell now."""
        return self._spells.bad(now_s, self.random)
