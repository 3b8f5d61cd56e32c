"""LayerWrapper: base of this library's wrappers; and random numbers for them."""

import inspect
import warnings
import zlib
from collections.abc import Mapping
from typing import Any, ClassVar, SupportsFloat

import gymnasium as gym
import numpy as np

from safe_wrappers.checks import numbers_of, shown
from safe_wrappers.errors import ActionError, UnsupportedEnvError
from safe_wrappers.plants.default import PlantTemplate
from safe_wrappers.plants.env_checks import wrappers_of
from safe_wrappers.serialize import recorded
from safe_wrappers.stack import Layer, refuse_order
from safe_wrappers.wrappers.common.episode_guard import EpisodeGuard

Env = gym.Env[Any, Any]
Reset = tuple[Any, dict[str, Any]]
"""What `reset` returns: observation and info."""
Step = tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]
"""What `step` returns: observation, reward, terminated, truncated and info."""


_WRAPPERS = __name__.rpartition(".common.")[0]


class LayerWrapper(EpisodeGuard, gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """A wrapper with a place in the stack, whose arguments are recorded in the env's spec."""

    layer: ClassVar[Layer]

    def __init__(self, env: Env) -> None:
        refuse_vector_env(env, type(self).__name__)
        refuse_order(env, self.layer, type(self).__name__)
        gym.Wrapper.__init__(self, env)
        self.await_reset()
        self.warned: set[str] = set()
        innermost = not any(isinstance(inner, LayerWrapper) for inner in wrappers_of(env))
        self._passes_numbers = innermost and isinstance(env.action_space, gym.spaces.Box)

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

    def _record(self, arguments: Mapping[str, Any], **plain: Any) -> None:
        """Record the constructor's arguments (its `locals()`), some as plain data; a plant as a template."""
        if plain.get("plant") is not None:
            plain["plant"] = PlantTemplate(plain["plant"])
        gym.utils.RecordConstructorArgs.__init__(self, **recorded(arguments, **plain))


def refuse_vector_env(env: Any, name: str) -> None:
    """An error that says how to wrap each env of a vector env."""
    if isinstance(env, gym.vector.VectorEnv):
        raise UnsupportedEnvError(
            f"{name} wraps single envs, got {env!r}; wrap each env of it: gym.make_vec(id, num_envs=...,"
            f" vectorization_mode='sync', wrappers=[sw.protect, lambda env: sw.{name}(env, ...)])"
        )


class WrapperRng:
    """Random numbers apart from the env's, which paired runs need unchanged; a reset's seed starts them anew.

    The env's first seed is used where none was ever given. `stream` keeps it apart from others of the same seed.
    """

    def __init__(self, stream: str) -> None:
        self._stream = zlib.crc32(stream.encode())
        self._generator: np.random.Generator | None = None

    def reset(self, env: Env, seed: int | None) -> None:
        """Call it after the env's own reset."""
        if seed is None and self._generator is None:
            seed = env.unwrapped.np_random_seed
        if seed is not None:
            self._generator = np.random.default_rng([self._stream, abs(int(seed))])

    @property
    def draw(self) -> np.random.Generator:
        """The generator; an error before the first reset."""
        if self._generator is None:
            raise gym.error.ResetNeeded("call reset before step")
        return self._generator
