"""`line_world` with goals: the same point and wall, and a reward that is a function of the goals alone."""

import gymnasium as gym
import numpy as np
from line_world import HOLD, WALL, BehindTheWall, Line, drift, push, read
from stable_baselines3.common.monitor import Monitor

import safe_wrappers as sw


class GoalLine(Line):
    """Pays minus the distance to a goal that is drawn at every reset; each observation has a number of its own."""

    def __init__(self):
        super().__init__()
        one = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
        three = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
        parts = {"observation": three, "achieved_goal": one, "desired_goal": one}
        self.observation_space = gym.spaces.Dict(parts)

    def reset(self, *, seed=None, options=None):
        self.goal = np.zeros(1, np.float32)
        super().reset(seed=seed)
        self.goal = self.np_random.uniform(-1.0, 0.5, 1).astype(np.float32)
        return self.observed(), {}

    def observed(self):
        at = np.append(super().observed(), self.np_random.uniform()).astype(np.float32)
        return {"observation": at, "achieved_goal": at[:1].copy(), "desired_goal": self.goal.copy()}

    def step(self, action):
        observation, _, terminated, truncated, info = super().step(action)
        info["bonus"] = 100.0 * self.steps
        reward = self.compute_reward(observation["achieved_goal"], self.goal, info)
        return observation, float(reward), terminated, truncated, info

    def compute_reward(self, achieved_goal, desired_goal, info):
        """Minus the distance, (...), in the precision of the goals."""
        return -np.linalg.norm(achieved_goal - desired_goal, axis=-1)


def filtered(wall=WALL, task=GoalLine):
    plant = sw.AnalyticPlant(f=drift, g=push, state=read, control_dt=HOLD)
    return Monitor(sw.RecordInterventions(sw.CBFActionFilter(task(), [BehindTheWall(wall)], plant=plant)))
