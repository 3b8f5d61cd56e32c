"""What goes wrong between a policy and a robot, as seeded wrappers: to test with, and to train against."""

import copy
from abc import ABC, abstractmethod
from typing import Any, ClassVar, Final, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from safe_wrappers import info as keys
from safe_wrappers.errors import ConfigurationError, non_negative, numbers_of, positive
from safe_wrappers.plants.env_checks import check_timing, wrappers_of
from safe_wrappers.wrappers.layer import (
    CommandReceiver,
    Env,
    LayerWrapper,
    Step,
    WrapperRng,
    action_array,
    receiver_inside,
)
from safe_wrappers.wrappers.stack import Layer

__all__ = [
    "FAULTS",
    "Fault",
    "Jitter",
    "Outages",
    "RepeatedCommands",
]

_DECIDING: Final = (Layer.FILTER, Layer.LEASE, Layer.CHANNEL, Layer.HANDOVER)
"""Layers that have an answer to an action that is not finite."""


class Carried(NamedTuple):
    """A command on its way."""

    action: Any  # as the policy gave it
    observed_s: float  # when the observation was returned that it was made from, s


class Fault(LayerWrapper, CommandReceiver, ABC):
    """Base of the faults.

    Put it outermost. It tells the `CommandReceiver` inside how old a command is, or that none has come; without one
    the robot goes on with the last command. Faults may be nested. A chunk is carried, lost or repeated as a whole.

    Info, at every step: ``fault/active`` (bool).

    Args:
        env: With a Box action space; it must say how long a step lasts (`dt`) if nothing inside counts the time.

    Raises:
        ConfigurationError: Another action space, or no control interval.
        ActionError: No numbers, another shape, or, where no layer inside decides, not finite; the env was not
            stepped, and nothing was carried.
    """

    layer: ClassVar = Layer.FAULT

    _last: Any

    def __init__(self, env: Env) -> None:
        LayerWrapper.__init__(self, env)
        if not isinstance(env.action_space, gym.spaces.Box):
            raise ConfigurationError(f"a fault carries actions of a Box action space, got {env.action_space}")
        self._inside = receiver_inside(env)
        self.control_dt = 0.0 if self._inside is not None else check_timing(env)
        self._passes_numbers = not any(
            getattr(inner, "layer", None) in _DECIDING for inner in wrappers_of(env)
        )
        # Nested faults of one kind must not strike together.
        faults = [inner for inner in wrappers_of(env) if isinstance(inner, Fault)]
        same = sum(isinstance(inner, type(self)) for inner in faults)
        self._nested = bool(faults)
        self.random = WrapperRng(type(self).__name__ + (f" {same + 1}" if same else ""))

    def _begin(self, observation: Any, info: dict[str, Any], seed: int | None) -> Any:
        self.random.reset(self.env, seed)
        self._steps_done, self._observed_s = 0, 0.0
        space: Any = self.env.action_space
        self._last = np.clip(np.zeros(space.shape), space.low, space.high).astype(space.dtype)
        self.begin()
        info[keys.FAULT_ACTIVE] = False
        return observation

    def step(self, action: Any) -> Step:
        """Carry the action, or not, and step the env with what arrives."""
        self._refuse_without_reset()
        self._refuse_what_is_no_action(action)
        given = None if self._observed_s is None else Carried(copy.copy(action), self._observed_s)
        arrived = self.carry(given, self.now_s)
        active = arrived is not given or arrived is None
        if arrived is not None:
            self._last = arrived.action
        if self._inside is not None:
            self._inside.set_observation_time(None if arrived is None else arrived.observed_s)
        observation, reward, terminated, truncated, info = self.env.step(copy.copy(self._last))
        self._steps_done += 1
        self._observed_s = self.now_s
        info[keys.FAULT_ACTIVE] = bool(active or (self._nested and info[keys.FAULT_ACTIVE]))
        return observation, reward, terminated, truncated, info

    @property
    def now_s(self) -> float:
        return super().now_s if self._inside is None else self._inside.now_s

    def admits(self, end: NDArray[np.float64], steps: int) -> bool:
        return self._inside is None or self._inside.admits(end, steps)

    def _refuse_what_is_no_action(self, action: Any) -> None:
        """Now, and not when it arrives, at a step whose action is a right one."""
        self._refuse_what_is_not_finite(action)
        space: Any = self.action_space
        given = numbers_of(action)
        # Of a `ChunkHandover` with chunks of one entry actions (m,) are taken, too.
        if given is None or given.ndim == 0 or (1, *given.shape) != space.shape:
            action_array(action, space.shape)

    def begin(self) -> None:
        """A new episode; `random` is ready."""

    @abstractmethod
    def carry(self, given: Carried | None, now_s: float) -> Carried | None:
        """What arrives at the robot now, of what the policy gave now; None if a fault outside lost it."""


def probability(name: str, value: float) -> float:
    """A number from 0 to 1, or an error that names the parameter."""
    number = non_negative(name, value, "a probability")
    if number > 1.0:
        raise ConfigurationError(f"{name} is a probability from 0 to 1, got {value!r}")
    return number


class RepeatedCommands(Fault):
    """Loses a `share` of the commands, from 0 to 1, each by itself, and sends the last one once more."""

    def __init__(self, env: Env, share: float) -> None:
        self._share = probability("share", share)
        super().__init__(env)

    def begin(self) -> None:
        self._before: Carried | None = None

    def carry(self, given: Carried | None, now_s: float) -> Carried | None:
        if self.random.draw.random() < self._share:
            return self._before
        self._before = given if given is not None else self._before
        return given


class Jitter(Fault):
    """Delays every command by a random time, uniform from 0 to `longest_s`, drawn for each by itself.

    At every step the newest command arrives that is there and newer than all that came before; commands that were
    overtaken are lost.
    """

    def __init__(self, env: Env, longest_s: float) -> None:
        self._longest_s = positive("longest_s", longest_s, "s")
        super().__init__(env)

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


class Outages(Fault):
    """Loses all commands during outages of `mean_length_s`, `mean_between_s` apart, s on average."""

    def __init__(self, env: Env, mean_between_s: float, mean_length_s: float) -> None:
        self._process = OnOffProcess(mean_between_s, mean_length_s)
        super().__init__(env)

    def begin(self) -> None:
        self._process.begin(self.random)

    def carry(self, given: Carried | None, now_s: float) -> Carried | None:
        return None if self._process.is_on(now_s, self.random) else given


FAULTS: dict[str, type[Fault]] = {kind.__name__: kind for kind in (Jitter, Outages, RepeatedCommands)}
"""By name, for configs."""
