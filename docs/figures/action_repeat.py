"""A policy that decides for four control steps at a time, and what the filter makes of each of them."""

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _style import OFF, ON, panels

REPEAT, DECISIONS = 4, 30


class Executed(gym.Wrapper):
    """Keeps what the filter executed in each control step."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.drives: list[float] = []

    def step(self, action: np.ndarray) -> tuple:
        """One control step."""
        answer = self.env.step(action)
        self.drives.append(float(answer[4]["executed_action"][0]))
        return answer


def draw() -> Figure:
    """The drive over time."""
    figure, ax = panels(height=2.4)
    seen = Executed(sw.protect(gym.make("SafePointGoal1-v0")))
    env = sw.ActionRepeat(seen, repeat=REPEAT)
    env.reset(seed=1)
    rng = np.random.default_rng(0)
    proposed = rng.uniform(0.2, 1.0, DECISIONS)
    for drive in proposed:
        env.step(np.array([drive, 0.0]))
    times = 0.02 * np.arange(REPEAT * DECISIONS)
    ax.step(times, np.repeat(proposed, REPEAT), where="post", color=OFF, label="proposed, four steps each")
    ax.step(times, seen.drives, where="post", color=ON, label="executed")
    ax.set(xlabel="time (s)", ylabel="drive", ylim=(-0.2, 1.4))
    ax.legend(loc="upper right", ncols=2)
    return figure
