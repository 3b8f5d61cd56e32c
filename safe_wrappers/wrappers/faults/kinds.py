"""The faults: some strike each command by itself, others last for a while."""

import math
from abc import abstractmethod
from typing import ClassVar

from safe_wrappers.checks import non_negative, positive
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.wrappers.common.layer import Env, WrapperRng
from safe_wrappers.wrappers.faults.fault import Carried, Fault


def probability(name: str, value: float) -> float:
    """A number from 0 to 1, or an error that names the parameter."""
    number = non_negative(name, value, "a probability")
    if number > 1.0:
        raise ConfigurationError(f"{name} is a probability from 0 to 1, got {value!r}")
    return number


class Struck(Fault):
    """Loses the commands that it strikes, or sends the one from before instead, with its old observation time."""

    repeats: ClassVar[bool] = False

    @abstractmethod
    def strikes(self, now_s: float) -> bool:
        """Whether it strikes the command of now; called once per step."""

    def begin(self) -> None:
        self._before: Carried | None = None

    def carry(self, given: Carried | None, now_s: float) -> Carried | None:
        if self.strikes(now_s):
            return self._before if self.repeats else None
        self._before = given if given is not None else self._before
        return given


class ShareFault(Struck):
    """Base of the faults that strike a share of the commands: the probability, from 0 to 1, for each by itself."""

    def __init__(self, env: Env, share: float, control_dt: float | None = None) -> None:
        self._share = probability("share", share)
        super().__init__(env, control_dt, share=self._share)

    def strikes(self, now_s: float) -> bool:
        return bool(self.random.draw.random() < self._share)


class Jitter(Fault):
    """Delays every command by a random time, uniform from 0 to `longest_s`, drawn for each by itself.

    At every step the newest command arrives that is there and newer than all that came before; commands that were
    overtaken are lost.
    """

    def __init__(self, env: Env, longest_s: float, control_dt: float | None = None) -> None:
        self._longest_s = positive("longest_s", longest_s, "s")
        super().__init__(env, control_dt, longest_s=self._longest_s)

    def begin(self) -> None:
        self._coming: list[tuple[float, Carried]] = []

    def carry(self, given: Carried | None, now_s: float) -> Carried | None:
        if given is not None:
            self._coming.append((now_s + self.random.draw.uniform(0.0, self._longest_s), given))
        there = [command for due_s, command in self._coming if due_s <= now_s]
        if not there:
            return None
        newest = max(there, key=lambda command: command.observed_s)
        self._coming = [(due, c) for due, c in self._coming if c.observed_s > newest.observed_s]
        return newest


class ClockSkew(Fault):
    """Gives the observation times of a clock that is off, and runs at another rate: `(1 + drift) t + offset_s`.

    A clock that is ahead (`offset_s` > 0, in s; `drift` is in s/s) makes commands look younger, or from the future.
    """

    def __init__(
        self, env: Env, offset_s: float = 0.0, drift: float = 0.0, control_dt: float | None = None
    ) -> None:
        for name, value in (("offset_s", offset_s), ("drift", drift)):
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                raise ConfigurationError(f"{name} is a finite number, got {value!r}")
        if offset_s == 0.0 and drift == 0.0:
            raise ConfigurationError("a clock with neither offset_s nor drift is right; give one of them")
        super().__init__(env, control_dt, offset_s=offset_s, drift=drift)
        self._offset_s, self._drift = offset_s, drift

    def carry(self, given: Carried | None, now_s: float) -> Carried | None:
        if given is None:
            return None
        return Carried(given.action, (1.0 + self._drift) * given.observed_s + self._offset_s)


class OnOffProcess:
    """A process that is off and on by turns, both for exponentially distributed times (means in s); it begins off."""

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


class OnOffFault(Struck):
    """Base of the faults that are on for `mean_length_s` at a time, then off for `mean_between_s`, on average, s."""

    def __init__(
        self, env: Env, mean_between_s: float, mean_length_s: float, control_dt: float | None = None
    ) -> None:
        self._process = OnOffProcess(mean_between_s, mean_length_s)
        super().__init__(env, control_dt, mean_between_s=mean_between_s, mean_length_s=mean_length_s)

    def begin(self) -> None:
        super().begin()
        self._process.begin(self.random)

    def strikes(self, now_s: float) -> bool:
        return self._process.is_on(now_s, self.random)


class DroppedRefreshes(ShareFault):
    """Loses a `share` of the commands, from 0 to 1, each by itself."""


class RepeatedCommands(ShareFault):
    """Loses a `share` of the commands, from 0 to 1, each by itself, and sends the last one once more."""

    repeats = True


class Outages(OnOffFault):
    """Loses all commands during outages of `mean_length_s`, `mean_between_s` apart, s on average."""


class FrozenPolicy(OnOffFault):
    """Repeats the last command from before for `mean_length_s`, then works for `mean_between_s`, on average, s."""

    repeats = True
