"""ClockSkew: the policy's clock is not the robot's."""

import math
from typing import Any

import gymnasium as gym

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.wrappers.faults.fault import Carried, Fault


class ClockSkew(Fault):
    """Stamps commands by a clock that is off, and runs at another rate: `(1 + drift) t + offset_s`.

    A clock that is ahead makes commands look younger than they are, or from the future; one that is behind makes
    them look old.

    Args:
        env: See `Fault`.
        offset_s: s, positive for a clock that is ahead.
        drift: Seconds per second.
        hold_s: See `Fault`.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        offset_s: float = 0.0,
        drift: float = 0.0,
        hold_s: float | None = None,
    ) -> None:
        for name, value in (("offset_s", offset_s), ("drift", drift)):
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                raise ConfigurationError(f"{name} is a finite number, got {value!r}")
        if offset_s == 0.0 and drift == 0.0:
            raise ConfigurationError("a clock with neither offset_s nor drift is right; give one of them")
        gym.utils.RecordConstructorArgs.__init__(self, offset_s=offset_s, drift=drift, hold_s=hold_s)
        Fault.__init__(self, env, hold_s)
        self._offset_s, self._drift = offset_s, drift

    def carry(self, given: Carried | None, now_s: float) -> Carried | None:
        """The command with another stamp."""
        if given is None:
            return None
        return Carried(given.action, (1.0 + self._drift) * given.observed_s + self._offset_s)
