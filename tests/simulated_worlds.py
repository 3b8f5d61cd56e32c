"""Small envs for the tests of simulation: carts, a grid, and envs whose copies are wrong."""

import gymnasium as gym
import numpy as np

WALL, TOP = 5.0, 1.0
"""Where the cart must stop, m, and its strongest deceleration, m/s^2."""
DT = 0.1


class Cart(gym.Env):
    """A point that drives along a line towards a wall at 5 m; state and observation are (x, v)."""

    dt = DT
    noise = 0.0

    def __init__(self, start=(0.0, 0.0)):
        self.action_space = gym.spaces.Box(-TOP, TOP, (1,), np.float64)
        self.observation_space = gym.spaces.Box(-1e3, 1e3, (2,), np.float64)
        self.start = start

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.v = self.start
        return self._observe(), {"cost": 0.0}

    def step(self, action):
        u = float(np.clip(np.asarray(action), -TOP, TOP)[0])
        if self.noise:
            u += self.noise * self.np_random.standard_normal()
        self.x += self.v * DT + 0.5 * u * DT * DT
        self.v += u * DT
        return self._observe(), -abs(self.x), False, False, {"cost": float(self.x > WALL)}

    def _observe(self):
        return np.array([self.x, self.v])


class NoisyCart(Cart):
    noise = 0.5


class WaitingCart(Cart):
    """Cannot be copied: it holds a generator."""

    def __init__(self, start=(0.0, 0.0)):
        super().__init__(start)
        self.waiting = (one for one in ())


class SharedCart(Cart):
    """Its copies drift: they share a list through the class."""

    steps = [0]  # noqa: RUF012 - what is wrong with it

    def reset(self, *, seed=None, options=None):
        self.steps[0] = 0
        return super().reset(seed=seed, options=options)

    def step(self, action):
        self.steps[0] += 1
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward + self.steps[0], terminated, truncated, info


class SharedSight(SharedCart):
    """Only what is seen drifts."""

    def step(self, action):
        observation, reward, terminated, truncated, info = Cart.step(self, action)
        self.steps[0] += 1
        return observation + np.array([self.steps[0], 0.0]), reward, terminated, truncated, info


GRID = ["S..#", ".#..", "...#", "#..G"]
MOVES = ((0, -1), (1, 0), (0, 1), (-1, 0))


class Grid(gym.Env):
    """A grid with pits ("#"), which cost 1 per step; moves are numbered from `start`; observes (column, row)."""

    frame_skip = 1

    def __init__(self, start=0):
        self.action_space = gym.spaces.Discrete(4, start=start)
        self.observation_space = gym.spaces.Box(0.0, 3.0, (2,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at = (0, 0)
        return np.array(self.at, dtype=np.float64), {"cost": 0.0}

    def step(self, action):
        (x, y), (dx, dy) = self.at, MOVES[int(action - self.action_space.start)]
        self.at = (min(max(x + dx, 0), 3), min(max(y + dy, 0), 3))
        kind = GRID[self.at[1]][self.at[0]]
        return (
            np.array(self.at, dtype=np.float64),
            float(kind == "G"),
            kind == "G",
            False,
            {"cost": float(kind == "#")},
        )
