"""Drivers of MuJoCo envs, seeded, and the loop that runs them."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

import safe_wrappers as sw
from _style import OFF, ON
from safe_wrappers.errors import Array


def sides(env_id: str, constraint: Any) -> tuple[tuple[Any, str, str], ...]:
    """An env without and with a filter, each with its colour and its name; episodes have no end."""
    bare, filtered = (gym.make(env_id).unwrapped for _ in range(2))
    return (
        (bare, OFF, "unfiltered"),
        (sw.CBFActionFilter(filtered, [constraint]), ON, "filtered"),
    )


def bang_bang(size: float, often: float, seed: int = 0) -> Callable[[Any], Any]:
    """Every actuator at one end or the other of [-size, size], chosen anew in a share `often` of the steps."""
    rng = np.random.default_rng(seed)
    state: dict[str, Any] = {}

    def act(env: Any) -> Any:
        if not state or rng.random() < often:
            state["action"] = rng.choice([-size, size], env.action_space.shape).astype(env.action_space.dtype)
        return state["action"]

    return act


def drive(
    env: gym.Env[Any, Any],
    driver: Callable[[Any], Any],
    steps: int,
    read: Callable[[Any, dict[str, Any]], Any],
) -> tuple[Array, list[dict[str, Any]]]:
    """What `read` reads after every step (episodes are not ended), and the infos."""
    env.reset(seed=0)
    seen, infos = [], []
    for _ in range(steps):
        info = env.step(driver(env))[4]
        seen.append(read(env.unwrapped, info))
        infos.append(info)
    return np.array(seen), infos
