"""How old a command is when it arrives, under each fault."""

from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

from _cart import Cart
from _style import GRID, ON
from safe_wrappers.wrappers import faults
from safe_wrappers.wrappers.layer import CommandReceiver

STEP_S, STEPS = 0.05, 100
KINDS: tuple[tuple[str, dict[str, float]], ...] = (
    ("DroppedRefreshes", {"share": 0.3}),
    ("Outages", {"mean_between_s": 1.0, "mean_length_s": 0.5}),
    ("FrozenPolicy", {"mean_between_s": 1.0, "mean_length_s": 0.5}),
    ("RepeatedCommands", {"share": 0.3}),
    ("Jitter", {"longest_s": 0.3}),
)


class Arrivals(gym.Wrapper[Any, Any, Any, Any], CommandReceiver):
    """Writes down when something arrives, and its stamp."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.steps, self.seen = 0, []

    @property
    def now_s(self) -> float:
        """Seconds so far."""
        return self.steps * STEP_S

    def set_observation_time(self, observed_s: float | None) -> None:
        """One command, or none."""
        if observed_s is not None:
            self.seen.append((self.now_s, self.now_s - observed_s))

    def step(self, action: Any) -> Any:
        """One control step."""
        self.steps += 1
        return self.env.step(action)


def draw() -> Figure:
    """Six panels; a gap is a step at which nothing arrived."""
    figure = Figure(figsize=(7.2, 3.6))
    axes = figure.subplots(2, 3, sharex=True, sharey=True)
    for ax, (name, arguments) in zip(axes.flat, KINDS, strict=True):
        arrivals = Arrivals(Cart((0.0, 0.0), dt=STEP_S))
        env = faults.FAULTS[name](arrivals, **arguments)
        env.reset(seed=3)
        for _ in range(STEPS):
            env.step(np.zeros(1))
        ax.axhline(0.0, color=GRID, lw=0.8)
        ax.plot(*np.array(arrivals.seen).T, ".", color=ON, ms=4)
        ax.set_title(name)
    for ax in axes[1]:
        ax.set_xlabel("time (s)")
    for ax in axes[:, 0]:
        ax.set_ylabel("age (s)")
    return figure
