"""What goes wrong between a policy and a robot, as seeded wrappers: to test with, and to train against."""

import copy
from abc import ABC, abstractmethod
from typing import Any, ClassVar, Final, NamedTuple

import gymnasium as gym
import numpy as np

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

    def __init__(self, env: Env) -> None:
        LayerWrapper.__init__(self, env)
        if not isinstance(env.action_space, gym.spaces.Box):
            raise ConfigurationError(f"a fault carries actions of a Box action space, got {env.action_space}")
        self._inside = receiver_inside(env)
        self.control_dt = 0.0 if self._inside is not None else check_timing(env)
        self._passes_numbers = not any(
            getattr(inner, "layer", None) in _DECIDING for inner in wrappers_of(env)
        )
        self._nested = any(isinstance(inner, Fault) for inner in wrappers_of(env))
        # Nested faults of one kind must not strike together.
        same = sum(isinstance(inner, type(self)) for inner in wrappers_of(env))
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


class Outages(Fault):
    """Loses all commands during outages of `mean_length_s`, `mean_between_s` apart, s on average.

    Both times are exponentially distributed; an episode begins without an outage.
    """

    def __init__(self, env: Env, mean_between_s: float, mean_length_s: float) -> None:
        self._between_s = positive("mean_between_s", mean_between_s, "s")
        self._length_s = positive("mean_length_s", mean_length_s, "s")
        super().__init__(env)

    def begin(self) -> None:
        self._on = False
        self._until_s = self.random.draw.exponential(self._between_s)

    def carry(self, given: Carried | None, now_s: float) -> Carried | None:
        while now_s >= self._until_s:
            self._on = not self._on
            self._until_s += self.random.draw.exponential(self._length_s if self._on else self._between_s)
        return None if self._on else given


FAULTS: dict[str, type[Fault]] = {kind.__name__: kind for kind in (Outages, RepeatedCommands)}
"""By name, for configs."""
