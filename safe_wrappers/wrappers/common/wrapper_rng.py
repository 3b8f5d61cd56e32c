"""WrapperRng: random numbers of a wrapper, apart from the env's generator."""

import zlib
from typing import Any

import gymnasium as gym
import numpy as np


class WrapperRng:
    """Random numbers apart from the env's, which paired runs need unchanged; a reset's seed starts them anew.

    The env's first seed is used where none was ever given. `stream` keeps it apart from others of the same seed.
    """

    def __init__(self, stream: str) -> None:
        self._stream = zlib.crc32(stream.encode())
        self._generator: np.random.Generator | None = None

    def reset(self, env: gym.Env[Any, Any], seed: int | None) -> None:
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
