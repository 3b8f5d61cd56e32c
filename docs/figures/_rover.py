"""SafeRover on open ground, with the slip limiter and without."""

from typing import Any

import gymnasium as gym
import numpy as np

import safe_wrappers as sw

FULL_THROTTLE = np.array([1.0, 1.0, 1.0, 1.0, 0.0], np.float32)
STEP_S = 0.01
OPEN = {"agent": [0.0, 0.0, 0.0], "goal": [4.0, 4.0], "hazards": [], "patches": []}


def rover(limited: bool, **layout: Any) -> Any:
    """The env, reset on a layout without hazards."""
    env: Any = gym.make("SafeRover-v0", max_episode_steps=10_000)
    if limited:
        env = sw.SlipLimiter(env, wheels=env.unwrapped.wheels)
    env.reset(seed=0, options={"layout": OPEN | layout})
    return env
