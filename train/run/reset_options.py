"""ResetOptions: the same options at every reset."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym


class ResetOptions(gym.Wrapper[Any, Any, Any, Any]):
    """Gives options to every reset, those too of a vector env, which has none of its own.

    Args:
        env: Outermost, so that every layer hears of them.
        options: A reset's own come on top.
    """

    def __init__(self, env: gym.Env[Any, Any], options: Mapping[str, Any]) -> None:
        super().__init__(env)
        self._options = options

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Resets the env."""
        return self.env.reset(seed=seed, options={**self._options, **(options or {})})
