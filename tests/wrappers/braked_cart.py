"""A cart that is driven at a wall and has a brake, exact in continuous time."""

import math
from dataclasses import dataclass, fields

import gymnasium as gym
import numpy as np
from asking import pushed

import safe_wrappers as sw


@dataclass(eq=False)
class BrakedCart(gym.Env):
    """x'' = drive * throttle - braking * brake while it moves forward; the brake lets it stand.

    Actions are (throttle in [-1, 1], brake in [0, 1]). A command takes effect `delay_s` after it was sent; until the
    first one the cart rolls on. `reading` is `age_s` old and off by at most `noise`. Motion is solved piece by piece,
    so that `farthest` is exact between samples, too. A receding cart is not braked.
    """

    dt: float = 0.1
    wall: float = 10.0
    drive: float = 2.0
    braking: float = 4.0
    top: float = math.inf
    v: float = 0.0
    delay_s: float = 0.0
    age_s: float = 0.0
    noise: float = 0.0
    reserve: float = 0.0
    dtype: type = np.float32

    def __post_init__(self):
        self.start = 0.0, self.v
        low, high = np.array([[-1.0, 0.0], [1.0, 1.0]], self.dtype)
        self.action_space = gym.spaces.Box(low, high, dtype=self.dtype)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.v = (options or {}).get("start", self.start)
        self.t, self.readings, self.given = 0.0, 0, []
        self.applied, self.coming = (0.0, 0.0), []
        self.pieces = [(-math.inf, self.x, self.v, 0.0)]
        self.farthest = self.x
        self.hidden = np.random.default_rng(seed)
        return np.array([self.x, self.v]), {}

    def step(self, action):
        action = np.array(action)
        self.given.append(action)
        assert np.isfinite(action).all()
        throttle, brake = np.clip(action.astype(np.float64), [-1.0, 0.0], [1.0, 1.0])
        self.coming.append((self.t + self.delay_s, (float(throttle), float(brake))))
        end = len(self.given) * self.dt
        while self.coming and self.coming[0][0] < end:
            due, command = self.coming.pop(0)
            self.roll(due - self.t)
            self.applied = command
        self.roll(end - self.t)
        self.t = end
        return np.array([self.x, self.v]), -abs(float(throttle)), False, False, {}

    def roll(self, left):
        throttle, brake = self.applied
        while left > 0.0:
            pull, drag = throttle * self.drive, brake * self.braking
            a = pull
            if self.v > 0.0:
                a = pull - drag
            elif self.v == 0.0 and pull > 0.0:
                a = max(pull - drag, 0.0)
            if self.v >= self.top and a > 0.0:
                a = 0.0
            step, reached = left, None
            if self.v * a < 0.0 and -self.v / a <= step:
                step, reached = -self.v / a, 0.0
            if a > 0.0 and self.v < self.top and (self.top - self.v) / a < step:
                step, reached = (self.top - self.v) / a, self.top
            self.pieces.append((self.t, self.x, self.v, a))
            self.x += self.v * step + 0.5 * a * step**2
            self.v = self.v + a * step if reached is None else reached
            self.t += step
            left -= step
            self.farthest = max(self.farthest, self.x)

    def measured(self):
        """Clearance and approach speed as they were `age_s` ago, seen with an error."""
        self.readings += 1
        then = self.t - self.age_s
        since, x, v, a = next(p for p in reversed(self.pieces) if p[0] <= then)
        if since == -math.inf:  # before the episode it cruised
            since, a = 0.0, 0.0
        error = self.hidden.uniform(-self.noise, self.noise)
        past = then - since
        self.seen = self.wall - (x + v * past + 0.5 * a * past**2) + error, v + a * past
        return self.seen


def read_cart(env):
    """For LeaseExpiry's `clearance`: less what it may be wrong by, and what is to be kept."""
    clearance, speed = env.unwrapped.measured()
    return [clearance - env.unwrapped.reserve], [speed]


def lease(env, clearance, **options):
    """A LeaseExpiry, with the options of its budget among the others."""
    budget = {f.name: options.pop(f.name) for f in fields(sw.StoppingBudget) if f.name in options}
    return sw.LeaseExpiry(env, sw.StoppingBudget(clearance, **budget), **options)


def stop(plant):
    """Throttle off, full brake: LeaseExpiry's `fallback`."""
    return np.array([0.0, 1.0])


def cart_plant(dt, delay_s=0.0):
    """For fallbacks, which want one."""
    return pushed(lambda env: np.array([env.x, env.v]), [1.0, -1.0], control_dt=dt, delay_s=delay_s)
