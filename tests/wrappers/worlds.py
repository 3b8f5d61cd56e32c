"""Small worlds whose motion is known exactly: a cart on a line, pushed by a bounded acceleration."""

import gymnasium as gym
import numpy as np
from asking import pushed

import safe_wrappers as sw


class Cart(gym.Env):
    """x'' = u, integrated exactly; keeps what it was given and its largest position between samples."""

    def __init__(self, dt=0.1, latency_steps=0):
        self.dt = dt
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.latency_steps, self.given = latency_steps, []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = np.array((options or {}).get("state", [0.0, 0.0]), dtype=np.float64)
        self.queue = [0.0] * self.latency_steps
        self.farthest = self.state[0]
        return self.state.copy(), {}

    def step(self, action):
        self.given.append(action)
        self.queue.append(float(np.asarray(action)[0]))
        a = self.queue.pop(0)
        x, v = self.state
        times = np.linspace(0.0, self.dt, 21)
        path = x + v * times + 0.5 * a * times**2
        self.farthest = max(self.farthest, path.max())
        self.state = np.array([path[-1], v + a * self.dt])
        return self.state.copy(), 0.0, False, False, {}


def filtered_cart(constraints, *, dt=0.1, env=None, delay_s=0.0, **options):
    plant = pushed(lambda env: env.state, control_dt=dt, delay_s=delay_s)
    return sw.CBFActionFilter(env or Cart(dt), constraints, plant=plant, **options)


class Raw(sw.Constraint):
    """Normals and offsets that can be changed, or none."""

    def __init__(self, *fixed):
        self.fixed = fixed

    def rows(self):
        return sw.HalfSpaces(*map(np.array, self.fixed)) if self.fixed else sw.HalfSpaces.none(1)
