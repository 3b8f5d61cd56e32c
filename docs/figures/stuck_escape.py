"""A driver that pushes against the filter for ever, and what a drawn action does about it."""

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _style import OFF, ON, panels
from first_look import drive_to_goal, show_layout, towards_goal

LAYOUT = {"agent": [-1.2, 0.0, 0.0], "goal": [1.2, 0.0], "hazards": [[0.0, 0.0]], "vases": []}


def drive(escape_s: float) -> tuple[np.ndarray, np.ndarray]:
    """The path until the goal is reached, and whether the driver was stuck."""
    env = sw.protect(gym.make("SafePointGoal1-v0"), detour=False)
    env = sw.StuckEscape(env, progress=0.1, escape_s=escape_s)
    path, infos = drive_to_goal(env, LAYOUT, 3, lambda task: towards_goal(task).astype(np.float32))
    return path, np.array([False, *(info["cbf/stuck"] for info in infos)])


def draw() -> Figure:
    """Left: the paths. Right: the way along x over time, thick where it is stuck."""
    figure, (chart, way) = panels(2, height=2.8)
    for escape_s, color, name in ((0.0, OFF, "reports alone"), (1.0, ON, "escapes")):
        path, stuck = drive(escape_s)
        time = 0.02 * np.arange(len(path))
        chart.plot(*path.T, color=color)
        way.plot(time, path[:, 0], color=color, label=name)
        way.plot(time, np.where(stuck, path[:, 0], np.nan), color=color, lw=4.0, alpha=0.5)
    show_layout(chart, LAYOUT)
    chart.set(aspect="equal", xlabel="x (m)", ylabel="y (m)")
    way.set(xlabel="time (s)", ylabel="x (m)")
    way.legend(loc="lower right")
    return figure
