"""A point on a line, pushed left and right, and a filter that is known in closed form; with and without goals."""

from dataclasses import dataclass

import gymnasium as gym
import numpy as np
from stable_baselines3.common.monitor import Monitor

import safe_wrappers as sw

HOLD, WALL = 0.1, -0.3


class Line(gym.Env):
    """x' = u with u in [-2, 3], so that scaling is no identity; ends left of -1, is cut off after 9 steps.

    What it was given, from where, and what it paid, is in info, for a record that no wrapper has touched.
    """

    def __init__(self):
        self.action_space = gym.spaces.Box(-2.0, 3.0, (1,), np.float32)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.steps = float(self.np_random.uniform(-0.8, -0.4)), 0
        return self.observed(), {}

    def observed(self):
        return np.array([self.x, self.steps], np.float32)

    def step(self, action):
        given, before = float(action[0]), self.x
        self.x += HOLD * given
        self.steps += 1
        reward = 10.0 * self.x + 12.0 - 0.3 * given**2
        info = {"truth": {"given": given, "before": before, "paid": reward, "after": self.observed()}}
        return self.observed(), reward, self.x < -1.0, self.steps >= 9, info


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
        reward = self.compute_reward(observation["achieved_goal"], self.goal, info)
        return observation, float(reward), terminated, truncated, info

    def compute_reward(self, achieved_goal, desired_goal, info):
        """Minus the distance, (...), in the precision of the goals."""
        return -np.linalg.norm(achieved_goal - desired_goal, axis=-1)


@dataclass
class BehindTheWall(sw.Constraint):
    """x <= wall at the end of the hold, which is u <= (wall - x) / hold."""

    wall: float

    def rows(self):
        left = self.wall - self.plant.state[0]
        return sw.HalfSpaces(np.array([[self.plant.control_dt]]), np.array([left]))


class AsDict(gym.ObservationWrapper):
    """The same observation in two parts."""

    def __init__(self, env):
        super().__init__(env)
        parts = {"x": gym.spaces.Box(-np.inf, np.inf, (1,)), "steps": gym.spaces.Box(-np.inf, np.inf, (1,))}
        self.observation_space = gym.spaces.Dict(parts)

    def observation(self, observation):
        return {"x": observation[:1], "steps": observation[1:]}


def drift(x):
    return np.zeros(1)


def push(x):
    return np.ones((1, 1))


def read(env):
    return np.array([env.x])


def filtered(wall=WALL, task=Line):
    plant = sw.AnalyticPlant(f=drift, g=push, state=read, control_dt=HOLD)
    return Monitor(sw.RecordInterventions(sw.CBFActionFilter(task(), [BehindTheWall(wall)], plant=plant)))


def filtered_goals(wall=WALL):
    return filtered(wall, GoalLine)


def filtered_dict(wall=WALL):
    return AsDict(filtered(wall))
