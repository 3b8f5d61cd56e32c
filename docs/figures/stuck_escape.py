"""A driver that pushes against the filter for ever, and what a drawn action does about it."""

from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle

import safe_wrappers as sw
from _style import FORBIDDEN, OFF, ON, SAFE, panels
from first_look import towards_goal

LAYOUT = {"agent": [-1.2, 0.0, 0.0], "goal": [1.2, 0.0], "hazards": [[0.0, 0.0]], "vases": []}
STEPS = 1000


def drive(escape_s: float) -> tuple[np.ndarray, np.ndarray]:
    """The path until the goal is reached, and whether the driver was stuck."""
    env = sw.protect(gym.make("SafePointGoal1-v0"), detour=False)
    env = sw.StuckEscape(env, progress=0.1, escape_s=escape_s)
    env.reset(seed=3, options={"layout": LAYOUT})
    task: Any = env.unwrapped
    where, stuck = [task.agent_position], [False]
    for _ in range(STEPS):
        info = env.step(towards_goal(task).astype(np.float32))[4]
        where.append(task.agent_position)
        stuck.append(info["cbf/stuck"])
        if info["goal_met"]:
            break
    return np.array(where), np.array(stuck)


def draw() -> Figure:
    """Left: the paths. Right: the way along x over time, thick where it is stuck."""
    figure, (chart, way) = panels(2, height=2.8)
    for escape_s, color, name in ((0.0, OFF, "reports alone"), (1.0, ON, "escapes")):
        path, stuck = drive(escape_s)
        time = 0.02 * np.arange(len(path))
        chart.plot(*path.T, color=color)
        way.plot(time, path[:, 0], color=color, label=name)
        way.plot(time, np.where(stuck, path[:, 0], np.nan), color=color, lw=4.0, alpha=0.5)
    for center in LAYOUT["hazards"]:
        chart.add_patch(Circle(center, 0.2, color=FORBIDDEN, alpha=0.35, lw=0))
    chart.add_patch(Circle(LAYOUT["goal"], 0.3, fill=False, color=SAFE, lw=1.5))
    chart.set(aspect="equal", xlabel="x (m)", ylabel="y (m)")
    way.set(xlabel="time (s)", ylabel="x (m)")
    way.legend(loc="lower right")
    return figure
