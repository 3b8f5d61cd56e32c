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
    """Everything an agent sees of one episode, as bytes and plain values; of a vector env, of its first ones."""
    seen: list[Any] = [plain(env.reset(seed=seed)[0])]
    for action in actions(env, steps):
        answer = env.step(action)
        seen.append(plain(answer))
        if np.any(answer[2]) or np.any(answer[3]):
            break
    return seen


def plain(value: Any) -> Any:
    """What compares bit for bit: arrays as bytes."""
    if isinstance(value, np.ndarray):
        return [plain(one) for one in value] if value.dtype == object else value.tobytes()
    if isinstance(value, dict):
        return {key: plain(one) for key, one in value.items()}
    return tuple(plain(one) for one in value) if isinstance(value, tuple) else value
