"""Short episodes with seeded actions, and everything that an agent sees of them."""

from typing import Any

import gymnasium as gym
import numpy as np

STEPS = 60


def actions(env: Any, steps: int = STEPS, seed: int = 0) -> Any:
    """Bang-bang, held for a while: what makes a filter intervene."""
    rng = np.random.default_rng(seed)
    space = env.action_space
    if isinstance(space, gym.spaces.Discrete):
        return rng.integers(space.n, size=steps // 5 + 1).repeat(5)[:steps]
    held = rng.choice([0.0, 1.0], (steps // 10 + 1, *space.shape)).repeat(10, axis=0)[:steps]
    return (space.low + held * (space.high - space.low)).astype(space.dtype)


def lowest(env: Any) -> Any:
    """An action at the edge of the space."""
    space = env.action_space
    return 0 if isinstance(space, gym.spaces.Discrete) else space.low


def trace(env: Any, seed: int = 0, steps: int = STEPS) -> list[Any]:
    """Everything an agent sees of one episode, as bytes and plain values."""
    seen: list[Any] = [env.reset(seed=seed)[0].tobytes()]
    for action in actions(env, steps):
        observation, reward, terminated, truncated, info = env.step(action)
        seen.append((observation.tobytes(), float(reward), terminated, truncated, plain(info)))
        if terminated or truncated:
            break
    return seen


def plain(info: dict[str, Any]) -> dict[str, Any]:
    """Info whose arrays compare as bytes."""
    return {k: v.tobytes() if isinstance(v, np.ndarray) else v for k, v in info.items()}
