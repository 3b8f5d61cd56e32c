"""Paired timing: both sides in turn, many short batches, so that a noisy machine hits both alike."""

import statistics
import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np


def paired_us(sides: dict[str, Callable[[], object]], batch: int = 50, rounds: int = 40) -> dict[str, float]:
    """Median microseconds per call of each side, the batches interleaved."""
    for call in sides.values():
        for _ in range(batch):
            call()
    samples: dict[str, list[float]] = {name: [] for name in sides}
    for _ in range(rounds):
        for name, call in sides.items():
            start = time.perf_counter()
            for _ in range(batch):
                call()
            samples[name].append((time.perf_counter() - start) / batch * 1e6)
    return {name: statistics.median(values) for name, values in samples.items()}


def stepping(env: gym.Env[Any, Any]) -> Callable[[], None]:
    """A function that makes one step, over and over, with the same random actions for every env."""
    env.reset(seed=0)
    space: Any = env.action_space
    actions = np.random.default_rng(0).uniform(space.low, space.high, (256, *space.shape)).astype(space.dtype)
    turn = 0

    def step() -> None:
        nonlocal turn
        turn += 1
        _, _, terminated, truncated, _ = env.step(actions[turn % len(actions)])
        if terminated or truncated:
            env.reset(seed=0)

    return step
