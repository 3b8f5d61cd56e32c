"""Faults that last: outages of the link, and a policy that freezes."""

from typing import Any

import gymnasium as gym

from safe_wrappers.checks import positive
from safe_wrappers.deprecation import deprecated_parameters
from safe_wrappers.wrappers.common.wrapper_rng import WrapperRng
from safe_wrappers.wrappers.faults.fault import Carried, Fault


class OnOffProcess:
    """A process that is off and on by turns, both for exponentially distributed times; an episode begins off.

    Args:
        mean_between_s: Mean time off, s.
        mean_length_s: Mean time on, s.
    """

    def __init__(self, mean_between_s: float, mean_length_s: float) -> None:
        self._between = positive("mean_between_s", mean_between_s, "s")
        self._length = positive("mean_length_s", mean_length_s, "s")

    def begin(self, random: WrapperRng) -> None:
        """A new episode."""
        self._on = False
        self._until_s = random.draw.exponential(self._between)

    def is_on(self, now_s: float, random: WrapperRng) -> bool:
        """Whether it is on now; times must not run backwards."""
        while now_s >= self._until_s:
            self._on = not self._on
            self._until_s += random.draw.exponential(self._length if self._on else self._between)
        return self._on


@deprecated_parameters(renamed={"hold_s": "control_dt"})
class OnOffFault(Fault):
    """Base of the faults that are on for a while at a time.

    Args:
        env: See `Fault`.
        mean_between_s: Mean time from the end of the fault to its next start, s.
        mean_length_s: Mean time that it lasts, s.
        control_dt: See `Fault`.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        mean_between_s: float,
        mean_length_s: float,
        control_dt: float | None = None,
    ) -> None:
        self._process = OnOffProcess(mean_between_s, mean_length_s)
        super().__init__(env, control_dt, mean_between_s=mean_between_s, mean_length_s=mean_length_s)

    def begin(self) -> None:
        """An episode begins without the fault."""
        self._process.begin(self.random)

    def is_on(self, now_s: float) -> bool:
        """Whether the fault is on now."""
        return self._process.is_on(now_s, self.random)


class Outages(OnOffFault):
    """Loses all commands during outages of random length, at random times. Arguments: see `OnOffFault`."""

    def carry(self, given: Carried | None, now_s: float) -> Carried | None:
        """The command, or nothing."""
        return None if self.is_on(now_s) else given


class FrozenPolicy(OnOffFault):
    """Repeats, for random lengths of time, the last command from before. Arguments: see `OnOffFault`.

    Its observation time stays the old one: a command is as old as what it was made from, however often it is sent.
    """

    def begin(self) -> None:
        """An episode begins with a policy that works."""
        super().begin()
        self._frozen: Carried | None = None

    def carry(self, given: Carried | None, now_s: float) -> Carried | None:
        """The command, or the one from before."""
        if self.is_on(now_s):
            return self._frozen
        self._frozen = given if given is not None else self._frozen
        return given
