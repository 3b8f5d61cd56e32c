"""Lines that are told what to do and remember it."""

import gymnasium as gym
import numpy as np

import safe_wrappers as sw


class Line(gym.Env):
    """Every action counts; what was asked, and when, is kept."""

    def __init__(self, controls=1, low=-1.0, high=1.0, dtype=np.float32, dt=0.1, ends_at=None, infos=None):
        self.dt, self.ends_at, self.infos = dt, ends_at, infos
        self.action_space = gym.spaces.Box(low, high, (controls,), dtype)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.given, self.steps = [], 0
        self.noise = self.np_random.uniform()
        return self.seen(), {}

    def seen(self):
        return np.array([self.steps, self.noise])

    def step(self, action):
        assert isinstance(action, np.ndarray) and action.dtype == self.action_space.dtype
        assert action.shape == self.action_space.shape
        assert np.isfinite(action).all() and self.action_space.contains(action), action
        self.given.append(action.copy())
        self.steps += 1
        self.noise = self.np_random.uniform()
        info = {} if self.infos is None else self.infos(self)
        return self.seen(), 0.5 * self.steps, self.steps == self.ends_at, False, info


class Wander:
    """A fallback that never rests."""

    def __init__(self, seed, controls, scale):
        self.seed, self.controls, self.scale = seed, controls, scale

    def at(self, step):
        return self.scale * np.random.default_rng([self.seed, step]).uniform(-1, 1, self.controls)

    def __call__(self, plant):
        return self.at(int(plant.state[0]))


def counted(env):
    return np.array([float(env.steps)])


def still(x):
    return np.zeros(1)


def unmoved(x):
    return np.zeros((1, 1))


def counting_plant(dt=0.1):
    """Its state is the number of the control step."""
    return sw.AnalyticPlant(f=still, g=unmoved, state=counted, control_dt=dt)


class ChunkHandover(sw.ChunkHandover):
    """Tells of each step the longest blend that began in it, s, and the age of the observation that took over."""

    latency, blends = -1, (0,)

    def _take_over(self):
        newest = self._observed
        seam = super()._take_over()
        if self._observed > newest:
            self.latency = self._steps_done - self._observed
        return seam

    def _joined(self, fresh):
        found = super()._joined(fresh)
        self.blends += (0 if found is None else found[1],)
        return found

    def _fade_steps(self, target):
        steps = super()._fade_steps(target)
        self.blends += (steps,)
        return steps

    def reset(self, **options):
        observation, info = super().reset(**options)
        return observation, info | {"handover/latency": -1, "handover/blend_time": 0.0}

    def step(self, action):
        self.latency, self.blends = -1, (0,)
        *answer, info = super().step(action)
        longest = max(self.blends)
        told = (longest + 1) * self.control_dt if longest else 0.0
        return *answer, info | {"handover/latency": self.latency, "handover/blend_time": told}
