"""A cart that is pushed by bounded accelerations and integrated exactly: small enough to see everything."""

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

import safe_wrappers as sw
from safe_wrappers.errors import Array

_FINE = 20
"""Points per control step at which the motion is kept."""


class Cart(gym.Env[Array, Array]):
    """`x'' = u`, |u| <= `most` along each axis; starts at `start`, the position before the velocity."""

    def __init__(self, start: tuple[float, ...], dt: float, most: float = 1.0) -> None:
        self.start, self.dt = start, dt
        self.action_space = gym.spaces.Box(-most, most, (len(start) // 2,), np.float64)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (len(start),), np.float64)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Array, dict[str, Any]]:
        """Back to the start."""
        super().reset(seed=seed)
        self.state = np.array(self.start)
        self.fine = [self.state]
        return self.state, {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Hold an action for one control step."""
        x, v = np.split(self.state, 2)
        for t in np.linspace(0.0, self.dt, _FINE + 1)[1:]:
            self.fine.append(np.concatenate([x + v * t + 0.5 * action * t**2, v + action * t]))
        self.state = self.fine[-1]
        return self.state, 0.0, False, False, {}


class Run(NamedTuple):
    """A closed loop: fine times, positions and speeds; the executed controls."""

    t: Array
    x: Array
    v: Array
    u: Array


def plant(env: Cart) -> sw.AnalyticPlant:
    """What the filter believes."""
    axes = len(env.start) // 2
    return sw.AnalyticPlant(
        f=lambda x: np.concatenate([x[axes:], np.zeros(axes)]),
        g=lambda x: np.eye(2 * axes)[:, axes:],
        state=lambda raw: raw.state,
        control_dt=env.dt,
    )


def wall(at: float, braking: float = 1.0) -> sw.constraints.Clearance:
    """Stay left of a wall."""
    return sw.constraints.Clearance(
        [sw.constraints.Plane([at], [-1.0])], braking=braking, position=[0], velocity=[1]
    )


def run(dt: float, steps: int, constraint: Any) -> Run:
    """A cart on a line at full throttle, through a filter."""
    env = Cart((0.0, 0.0), dt)
    stack = sw.CBFActionFilter(env, [constraint], plant=plant(env))
    stack.reset(seed=0)
    u = np.array([stack.step(np.ones(1))[4]["executed_action"][0] for _ in range(steps)])
    fine = np.array(env.fine)
    return Run(np.arange(len(fine)) * dt / _FINE, *fine.T, u)
