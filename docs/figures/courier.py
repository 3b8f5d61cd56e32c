"""The tutorial's courier, by the tutorial's own code."""

import runpy
from pathlib import Path
from typing import Any
from unittest import mock

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from _style import FORBIDDEN, OFF, ON, panels

_PAGES = runpy.run_path(str(Path(__file__).parents[1] / "pages.py"))


def draw() -> Figure:
    """Left: the paths. Right: the speeds."""
    with mock.patch.dict(gym.registry):  # what the page registers is gone afterwards
        return _figure()


def _figure() -> Figure:
    names = _PAGES["run"]("tutorial/custom-env.md", until="make_courier")
    task = names["Courier"]
    figure, (chart, speed) = panels(2, height=2.5, width_ratios=[3, 2])
    for make, color, name in (
        (lambda: gym.make("Courier-v0"), OFF, "unfiltered"),
        (names["make_courier"], ON, "filtered"),
    ):
        states = _drive(make(), names["straight_ahead"])
        chart.plot(states[:, 0], states[:, 1], color=color)
        speed.plot(
            np.arange(len(states)) * task.dt, np.hypot(states[:, 2], states[:, 3]), color=color, label=name
        )
    for x, y, radius in task.pillars:
        chart.add_patch(Circle((x, y), radius, color=FORBIDDEN, alpha=0.35, lw=0))
        chart.add_patch(Circle((x, y), radius + task.radius, fill=False, color=FORBIDDEN, lw=0.8, ls=":"))
    chart.set(aspect="equal", xlabel="x (m)", ylabel="y (m)")
    speed.axhline(task.top_speed, color=FORBIDDEN, lw=1.2)
    speed.set(xlabel="time (s)", ylabel="speed (m/s)")
    speed.legend(loc="upper right")
    return figure


def _drive(env: Any, driver: Any) -> Any:
    env.reset(seed=0)
    states, done = [env.unwrapped.state], False
    while not done:
        *_, done, _, _ = env.step(driver(env))
        states.append(env.unwrapped.state)
    return np.array(states)
