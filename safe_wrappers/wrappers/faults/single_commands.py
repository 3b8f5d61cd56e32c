"""Faults that strike each command by itself: lost, repeated, delayed, or with a wrong observation time."""

import math
from typing import Any

import gymnasium as gym

from safe_wrappers.checks import positive
from safe_wrappers.deprecation import deprecated_parameters
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.wrappers.faults.fault import Carried, Fault
from safe_wrappers.wrappers.faults.parameters import probability


@deprecated_parameters(renamed={"hold_s": "control_dt"})
class ShareFault(Fault):
    """Base of the faults that strike a share of the commands.

    Args:
        env: See `Fault`.
        share: Probability that a command is struck, independently of the others, from 0 to 1.
        control_dt: See `Fault`.
    """

    def __init__(self, env: gym.Env[Any, Any], share: float, control_dt: float | None = None) -> None:
        self._share = probability("share", share)
        super().__init__(env, control_dt, share=self._share)

    def strikes(self) -> bool:
        """Whether it strikes the next command."""
        return bool(self.random.draw.random() < self._share)


class DroppedRefreshes(ShareFault):
    """Loses a share of the commands. Arguments: see `ShareFault`."""

    def carry(self, given: Carried | None, now_s: float) -> Carried | None:
        """The command, or nothing."""
        return None if self.strikes() else given


class RepeatedCommands(ShareFault):
    """Loses a share of the commands, and sends the one that arrived last once more. Arguments: see `ShareFault`.

    It keeps its old observation time.
    """

    def begin(self) -> None:
        """Nothing has arrived that could be repeated."""
        self._before: Carried | None = None

    def carry(self, given: Carried | None, now_s: float) -> Carried | None:
        """The command, or the one before."""
        if self.strikes():
            return self._before
        self._before = given if given is not None else self._before
        return given


@deprecated_parameters(renamed={"hold_s": "control_dt"})
class Jitter(Fault):
    """Delays every command by a random time, uniform from 0 to the longest, each by itself.

    At every step the newest command arrives that is there and newer than all that came before; if there is none,
    nothing arrives. So commands that were overtaken are lost.

    Args:
        env: See `Fault`.
        longest_s: s.
        control_dt: See `Fault`.
    """

    def __init__(self, env: gym.Env[Any, Any], longest_s: float, control_dt: float | None = None) -> None:
        self._longest_s = positive("longest_s", longest_s, "s")
        super().__init__(env, control_dt, longest_s=self._longest_s)

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


@deprecated_parameters(renamed={"hold_s": "control_dt"})
class ClockSkew(Fault):
    """Gives the observation times of a clock that is off, and runs at another rate: `(1 + drift) t + offset_s`.

    A clock that is ahead makes commands look younger than they are, or from the future; one that is behind makes
    them look old.

    Args:
        env: See `Fault`.
        offset_s: s, positive for a clock that is ahead.
        drift: Seconds per second.
        control_dt: See `Fault`.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        offset_s: float = 0.0,
        drift: float = 0.0,
        control_dt: float | None = None,
    ) -> None:
        for name, value in (("offset_s", offset_s), ("drift", drift)):
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                raise ConfigurationError(f"{name} is a finite number, got {value!r}")
        if offset_s == 0.0 and drift == 0.0:
            raise ConfigurationError("a clock with neither offset_s nor drift is right; give one of them")
        super().__init__(env, control_dt, offset_s=offset_s, drift=drift)
        self._offset_s, self._drift = offset_s, drift

    def carry(self, given: Carried | None, now_s: float) -> Carried | None:
        """The command with another observation time."""
        if given is None:
            return None
        return Carried(given.action, (1.0 + self._drift) * given.observed_s + self._offset_s)
