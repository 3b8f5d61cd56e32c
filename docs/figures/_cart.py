"""A cart on a line, pushed by a bounded acceleration and integrated exactly: small enough to see everything."""

from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

import safe_wrappers as sw
from safe_wrappers.errors import Array

_FINE = 20
"""Points per control step at which the motion is kept."""


class Cart(gym.Env[Array, Array]):
    """`x'' = strength u`, |u| <= 1, each command acting `latency` control steps late; starts at `start` (x, v)."""

    def __init__(
        self, start: tuple[float, float], dt: float, latency: int = 0, strength: float = 1.0
    ) -> None:
        self.start, self.dt, self.latency, self.strength = (start, dt, latency, strength)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Array, dict[str, Any]]:
        """Back to the start."""
        super().reset(seed=seed)
        self.state = np.array(self.start)
        self.fine = [self.state]
        self.flight = deque([0.0] * self.latency)
        return self.state, {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Hold an action for one control step."""
        self.flight.append(float(action[0]) * self.strength)
        a = self.flight.popleft()
        x, v = self.state
        for t in np.linspace(0.0, self.dt, _FINE + 1)[1:]:
            self.fine.append(np.array([x + v * t + 0.5 * a * t**2, v + a * t]))
        self.state = self.fine[-1]
        return self.state, 0.0, False, False, {}


class Run(NamedTuple):
    """A closed loop: fine times, positions and speeds; the executed controls; what the filter said."""

    t: Array
    x: Array
    v: Array
    u: Array
    infos: list[dict[str, Any]]


def plant(env: Cart, delay_s: float = 0.0) -> sw.AnalyticPlant:
    """What the filter believes: unit strength."""
    return sw.AnalyticPlant(
        f=lambda x: np.array([x[1], 0.0]),
        g=lambda x: np.array([[0.0], [1.0]]),
        state=lambda raw: raw.state,
        control_dt=env.dt,
        delay_s=delay_s,
    )


def wall(at: float, braking: float = 1.0, **more: Any) -> sw.constraints.Clearance:
    """Stay left of a wall."""
    return sw.constraints.Clearance(
        [sw.constraints.Plane([at], [-1.0])], braking=braking, position=[0], velocity=[1], **more
    )


def run(
    env: Cart,
    steps: int,
    constraints: list[Any] | None = None,
    driver: Callable[[Array], float] = lambda state: 1.0,
    delay_s: float = 0.0,
    **options: Any,
) -> Run:
    """Drive a cart, through a filter if there are constraints."""
    stack: Any = env
    if constraints is not None:
        stack = sw.CBFActionFilter(env, constraints, plant=plant(env, delay_s), **options)
    stack.reset(seed=0)
    infos = []
    for _ in range(steps):
        infos.append(stack.step(np.array([driver(env.state)]))[4])
    fine = np.array(env.fine)
    u = [i["executed_action"][0] for i in infos] if constraints is not None else []
    return Run(np.arange(len(fine)) * env.dt / _FINE, fine[:, 0], fine[:, 1], np.array(u), infos)
