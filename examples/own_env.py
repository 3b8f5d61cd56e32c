"""Any env: give the constraint and a backup policy; its own simulation is the model.

python examples/own_env.py --steps 2000
"""

import argparse
from typing import Any

import gymnasium as gym
import numpy as np

import safe_wrappers as sw

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=2_000)
steps = parser.parse_args().steps


class Ferry(gym.Env):
    """A ferry in a current; it must not drift over the weir at x = 0."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,))
    action_space = gym.spaces.Box(-1, 1, (1,))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start 5 to 8 m above the weir, at rest."""
        super().reset(seed=seed)
        self.x, self.v = self.np_random.uniform(5, 8), 0.0
        return np.array([self.x, self.v], np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """0.1 s of thrust against the current."""
        self.v += 0.1 * (2.0 * float(action[0]) - 0.5 * (self.v + 1.0))
        self.x += 0.1 * self.v
        return np.array([self.x, self.v], np.float32), -self.x, False, self.x > 20, {}


dry = sw.constraints.PredictiveShield(lambda x: x[0], horizon=30, backup=lambda x: [1.0])
for env in (Ferry(), sw.CBFActionFilter(Ferry(), [dry])):
    env.reset(seed=0)
    over = 0
    for _ in range(steps):
        down_the_river = np.array([-1.0], np.float32)
        observation, reward, terminated, truncated, info = env.step(down_the_river)
        over += observation[0] < 0
        if over == 1 or truncated:  # lost
            break
    print(f"{type(env).__name__}: {'over the weir' if over else f'holds at {observation[0]:.2f} m'}")
