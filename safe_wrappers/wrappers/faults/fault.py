"""Fault: a seeded wrapper between policy and robot that loses, repeats or delays commands."""

import copy
from abc import ABC, abstractmethod
from typing import Any, ClassVar, Final, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from safe_wrappers import info as keys
from safe_wrappers.checks import numbers_of
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.env_checks import check_timing, wrappers_of
from safe_wrappers.stack import Layer
from safe_wrappers.wrappers.common.layer import Env, LayerWrapper, Reset, Step, WrapperRng
from safe_wrappers.wrappers.common.receiver import CommandReceiver, action_array, receiver_inside

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
        control_dt: The time that a step lasts, s; None reads the env's.
        arguments: Of the fault itself, for the spec.

    Raises:
        ConfigurationError: Another action space, or no control interval.
        ActionError: No numbers, another shape, or, where no layer inside decides, not finite; the env was not
            stepped, and nothing was carried.
    """

    layer: ClassVar = Layer.FAULT

    _last: Any

    def __init__(self, env: Env, control_dt: float | None = None, **arguments: Any) -> None:
        self._record({"control_dt": control_dt, **arguments})
        LayerWrapper.__init__(self, env)
        if not isinstance(env.action_space, gym.spaces.Box):
            raise ConfigurationError(f"a fault carries actions of a Box action space, got {env.action_space}")
        self._inside = receiver_inside(env)
        self.control_dt = 0.0 if self._inside is not None else check_timing(env, control_dt)
        if self._inside is not None and control_dt is not None:
            inside = type(self._inside).__name__
            raise ConfigurationError(f"{inside} inside counts the time: leave control_dt out")
        self._passes_numbers = not any(
            getattr(inner, "layer", None) in _DECIDING for inner in wrappers_of(env)
        )
        # Nested faults of one kind must not strike together.
        faults = [inner for inner in wrappers_of(env) if isinstance(inner, Fault)]
        same = sum(isinstance(inner, type(self)) for inner in faults)
        self._nested = bool(faults)
        self.random = WrapperRng(type(self).__name__ + (f" {same + 1}" if same else ""))
        self._start()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Reset:
        """Reset the env, and what is on its way; the random numbers start anew with a seed."""
        observation, info = self.env.reset(seed=seed, options=options)
        self.random.reset(self.env, seed)
        self._start()
        self.begin()
        info[keys.FAULT_ACTIVE] = False
        return observation, info

    def step(self, action: Any) -> Step:
        """Carry the action, or not, and step the env with what arrives."""
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

    def admits_chunk(self, commands: NDArray[np.float64]) -> bool:
        return self._inside is None or self._inside.admits_chunk(commands)

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

    def _start(self) -> None:
        self._steps_done = 0
        self._observed_s = 0.0
        space: Any = self.env.action_space
        self._last = np.clip(np.zeros(space.shape), space.low, space.high).astype(space.dtype)
