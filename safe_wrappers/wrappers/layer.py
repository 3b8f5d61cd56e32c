"""Base of this library's wrappers, of those that are told how old a command is, and their random numbers."""

import inspect
import math
import warnings
import zlib
from collections.abc import Callable
from typing import Any, ClassVar, Final, Self, SupportsFloat

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from safe_wrappers import info as keys
from safe_wrappers.errors import (
    OF_NUMBERS,
    ActionError,
    ConfigurationError,
    UnsupportedEnvError,
    numbers_of,
    shown,
)
from safe_wrappers.plants.env_checks import wrappers_of
from safe_wrappers.wrappers.serialize import plain_data
from safe_wrappers.wrappers.stack import Layer, refuse_order

Env = gym.Env[Any, Any]
Reset = tuple[Any, dict[str, Any]]
"""What `reset` returns: observation and info."""
Step = tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]
"""What `step` returns: observation, reward, terminated, truncated and info."""


_WRAPPERS = __name__.rpartition(".")[0]
_UNKNOWN: Final[dict[str, Any]] = {"*arguments": []}
"""Recorded of a constructor whose arguments are not known: none takes it, so that `gym.make` takes no defaults."""


class LayerWrapper(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """A wrapper with a place in the stack, whose arguments are recorded in the env's spec."""

    layer: ClassVar[Layer]
    started: bool = False
    """Whether there is an episode, since the last reset has not failed."""

    def __new__(cls, *arguments: Any, **named: Any) -> Self:
        """A wrapper whose constructor's arguments are recorded as they were given, as plain data."""
        made = super().__new__(cls)
        if arguments or named:  # a copy is made without any, and gets the recorded ones with its state
            given = plain_data(_by_name(made, arguments, named))
            gym.utils.RecordConstructorArgs.__init__(made, **given)
        return made

    def __init__(self, env: Env) -> None:
        vars(self).setdefault("_saved_kwargs", _UNKNOWN)  # a subclass's `__new__` may pass on none
        refuse_vector_env(env, type(self).__name__)
        refuse_order(env, self.layer, type(self).__name__)
        gym.Wrapper.__init__(self, env)
        self.warned: set[str] = set()
        innermost = not any(isinstance(inner, LayerWrapper) for inner in wrappers_of(env))
        self._passes_numbers = innermost and isinstance(env.action_space, gym.spaces.Box)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take a copy's state; one whose env is made anew by its constructor (EzPickle) awaits a reset."""
        vars(self).update(state)
        if isinstance(self.unwrapped, gym.utils.EzPickle):
            self.started = False
            for env in wrappers_of(self):
                if isinstance(env, gym.wrappers.OrderEnforcing):
                    env._has_reset = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Reset:
        """Reset the env, and forget the last episode; random numbers start anew with a seed."""
        self.started = False
        observation, info = self.env.reset(seed=seed, options=options)
        observation = self._begin(observation, info, seed)
        self.started = True
        return observation, info

    def _begin(self, observation: Any, info: dict[str, Any], seed: int | None) -> Any:
        """Begin an episode by what the env's reset has returned: fill in the info, and return the observation."""
        return observation

    def _refuse_without_reset(self) -> None:
        """Commands of another episode, or of none, are not executed."""
        if not self.started:
            raise gym.error.ResetNeeded("call reset before step; the last one may have failed")

    def _make_steps(self, count: int, step: Callable[[], Step]) -> Step:
        """Make some control steps, fewer where the episode ends: rewards summed up, infos merged."""
        total: Any = 0.0
        infos = []
        for _ in range(count):
            observation, reward, terminated, truncated, info = step()
            total += float(reward)
            infos.append(dict(info))  # the env may use the same one again
            if terminated or truncated:
                break
        return observation, total, terminated, truncated, keys.merged(infos)

    def _pass_on(self, action: Any) -> Step:
        """Step the env with an action that this wrapper only passes on, to the env itself if it is finite."""
        self._refuse_what_is_not_finite(action)
        return self.env.step(action)

    def _refuse_what_is_not_finite(self, action: Any) -> None:
        if self._passes_numbers:
            given = numbers_of(action)
            if given is None or not np.isfinite(given).all():
                raise ActionError(
                    f"expected an action of finite numbers, got {shown(action)}; the env was not stepped"
                )

    def _warn_once(self, what: str, message: str, category: type[Warning] = UserWarning) -> None:
        """Warn, unless `warned` has it, at the line that called the outermost of this library's wrappers."""
        if what in self.warned:
            return
        self.warned.add(what)
        level, frame = 1, inspect.currentframe()
        while frame is not None and str(frame.f_globals.get("__name__")).startswith(_WRAPPERS):
            level, frame = level + 1, frame.f_back
        warnings.warn(message, category, stacklevel=level)

    def _widen_observation(self, name: str, more: spaces.Box) -> None:
        """A flat Box of floats becomes longer, a Dict gets an entry, any other becomes one of `"observation"`."""
        space = self.env.observation_space
        if (
            isinstance(space, spaces.Box)
            and len(space.shape) == 1
            and space.dtype in (np.float32, np.float64)
        ):
            low, high = (np.concatenate(ends) for ends in ((space.low, more.low), (space.high, more.high)))
            kind = space.dtype.type
            self.observation_space = spaces.Box(low.astype(kind), high.astype(kind), dtype=kind)
            return
        entries = space.spaces if isinstance(space, spaces.Dict) else {"observation": space}
        if name in entries:
            raise ConfigurationError(f"the observation has {name!r} already: {sorted(entries)}")
        self.observation_space = spaces.Dict({**entries, name: more})

    def _with_numbers(self, observation: Any, name: str, numbers: NDArray[Any]) -> Any:
        """The observation with the numbers that `_widen_observation` has announced."""
        space = self.observation_space
        if isinstance(space, spaces.Box):
            return np.concatenate([observation, numbers]).astype(space.dtype)
        assert isinstance(space, spaces.Dict)
        inside = isinstance(self.env.observation_space, spaces.Dict)
        entries = observation if inside else {"observation": observation}
        return {**entries, name: numbers.astype(space[name].dtype)}


def _by_name(made: Env, arguments: tuple[Any, ...], named: dict[str, Any]) -> dict[str, Any]:
    """What a constructor is given, but for the env; what has no name is under ``*name``, as in `_UNKNOWN`."""
    signature = inspect.signature(type(made).__init__)
    try:
        given = signature.bind(made, *arguments, **named)
    except TypeError:
        return _UNKNOWN  # `__init__` raises it anew, and names the class
    given.apply_defaults()
    found: dict[str, Any] = {}
    for name, value in given.arguments.items():
        kind = signature.parameters[name].kind
        if kind is inspect.Parameter.VAR_KEYWORD:
            found |= value
        elif kind is not inspect.Parameter.VAR_POSITIONAL:
            found[name] = value
        elif nameless := [one for one in value if not isinstance(one, gym.Env)]:
            found[f"*{name}"] = nameless
    return {name: value for name, value in found.items() if name != "env" and value is not made}


def refuse_vector_env(env: Any, name: str) -> None:
    """An error that says how to wrap each env of a vector env."""
    if isinstance(env, gym.vector.VectorEnv):
        raise UnsupportedEnvError(
            f"{name} wraps single envs, got {env!r}; wrap each env of it: gym.make_vec(id, num_envs=...,"
            f" vectorization_mode='sync', wrappers=[lambda env: {name}(env, ...)])"
        )


def mujoco_env(env: Env, name: str) -> Any:
    """The unwrapped env, or an error if it has no MuJoCo model and data."""
    raw: Any = env.unwrapped
    if not isinstance(getattr(raw, "model", None), mujoco.MjModel) or not hasattr(raw, "data"):
        raise UnsupportedEnvError(f"{name} needs an env with MuJoCo's .model and .data; {raw} has none")
    return raw


class WrapperRng:
    """Random numbers of a `stream` apart from the env's; a reset's seed starts them anew, at first the env's own."""

    draw: np.random.Generator
    """The generator, from the first reset on."""

    def __init__(self, stream: str) -> None:
        self._stream = zlib.crc32(stream.encode())

    def reset(self, env: Env, seed: int | None) -> None:
        """Call it after the env's own reset."""
        if seed is None and not hasattr(self, "draw"):
            seed = env.unwrapped.np_random_seed
        if seed is not None:
            self.draw = np.random.default_rng([self._stream, abs(int(seed))])


SAME_STEP: Final = 1e-6
"""Control steps: times that are closer count as the same."""


def whole_steps(time_s: float, control_dt: float) -> int:
    """Control steps that cover a time, rounded up."""
    return math.ceil(time_s / control_dt - SAME_STEP)


class CommandReceiver:
    """Base of `ChunkHandover`, `LeaseExpiry`, `TeleopChannel` and the faults.

    What carries actions (a fault, a queue, a network) calls `set_observation_time` before `step`; without a call the
    action was made from the newest observation.
    """

    control_dt: float
    """Control interval, s."""
    _steps_done: int = 0
    _observed_s: float | None = 0.0

    @property
    def now_s(self) -> float:
        """Seconds of the episode so far, on the clock of control steps."""
        return self._steps_done * self.control_dt

    def set_observation_time(self, observed_s: float | None) -> None:
        """Say which observation the next action is made from.

        Args:
            observed_s: When that observation was returned, s on the clock of `now_s`. None: no action arrives, the
                next step's is disregarded.

        Raises:
            ActionError: Not a finite time.
        """
        given = None if observed_s is None else numbers_of(observed_s)
        if observed_s is not None and (given is None or given.ndim or not np.isfinite(given)):
            raise ActionError(
                f"observed_s is a time in seconds, or None for nothing; got {shown(observed_s)}"
            )
        self._observed_s = observed_s


def receiver_inside(env: Env) -> CommandReceiver | None:
    """The outermost receiver among an env's wrappers."""
    return next((inner for inner in wrappers_of(env) if isinstance(inner, CommandReceiver)), None)


def action_array(action: Any, shape: tuple[int, ...], dtype: type | None = None) -> NDArray[Any]:
    """A copy of an action, in its own dtype unless told; an `ActionError` for another shape or no numbers."""
    given = numbers_of(action)
    if given is None:
        raise ActionError(f"expected an action of shape {shape}, {OF_NUMBERS}, got {shown(action)}")
    if given.shape != shape:
        raise ActionError(f"expected an action of shape {shape}, got shape {given.shape}")
    return given if dtype is None else given.astype(dtype, copy=False)
