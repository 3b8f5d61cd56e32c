"""Spells: a process that is well for a while, then not, then well again."""

from safe_wrappers.constraints.constraint import positive
from safe_wrappers.wrappers.own_random import OwnRandom


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
