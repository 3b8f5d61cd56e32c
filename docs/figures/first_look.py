"""The goal task with a driver that is blind to hazards, with the filter and without."""

import math
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray

import safe_wrappers as sw
from _style import FORBIDDEN, INK, OFF, ON, SAFE, bare, disc, panels

LAYOUT = {
    "agent": [-1.6, -1.0, 0.3],
    "goal": [1.7, 1.0],
    "hazards": [[-0.85, -0.6], [-0.1, -0.15], [0.6, 0.2], [0.95, 0.75], [-0.3, 0.6], [0.5, -0.7]],
    "vases": [],
}


def towards_goal(task: Any) -> NDArray[np.float64]:
    """Turn to the goal and push on."""
    offset = task.goal_position - task.agent_position
    angle = math.remainder(math.atan2(offset[1], offset[0]) - task.agent_heading, math.tau)
    return np.array([math.cos(angle), np.clip(3.0 * angle, -1.0, 1.0)])


def drive_to_goal(
    env: Any,
    layout: dict[str, Any] = LAYOUT,
    steer: Callable[[Any], NDArray[np.float64]] = towards_goal,
) -> tuple[NDArray[np.float64], list[dict[str, Any]]]:
    """Positions until the goal is reached, shape (k + 1, 2), and the infos of the k steps."""
    task = env.unwrapped
    env.reset(seed=0, options={"layout": layout})
    where, infos = [task.agent_position], []
    while len(infos) < 1000 and not (infos and infos[-1]["goal_met"]):
        infos.append(env.step(steer(task))[4])
        where.append(task.agent_position)
    return np.array(where), infos


def show_layout(ax: Axes, layout: dict[str, Any]) -> None:
    """The hazards and the goal."""
    for center in layout["hazards"]:
        disc(ax, center, 0.2)
    ax.add_patch(Circle(layout["goal"], 0.3, fill=False, color=SAFE, lw=1.5))


def draw() -> Figure:
    """Left: the paths. Right: the distance to the nearest hazard."""
    figure, (chart, distance) = panels(2, height=3.0, width_ratios=[5, 4])
    for env, color, name in (
        (gym.make("SafePointGoal1-v0"), OFF, "unfiltered"),
        (sw.protect(gym.make("SafePointGoal1-v0")), ON, "filtered"),
    ):
        task: Any = env.unwrapped
        path, infos = drive_to_goal(env)
        chart.plot(*path.T, color=color)
        gaps = np.linalg.norm(path[:, None] - task.hazard_positions, axis=2).min(axis=1) - task.hazard_radius
        label = f"{name}: {sum(info['cost_substep'] for info in infos):.0f} steps in violation"
        distance.plot(np.arange(len(path)) * task.dt, 100.0 * gaps, color=color, label=label)
    show_layout(chart, LAYOUT)
    chart.text(*LAYOUT["goal"], "goal", color=SAFE, ha="center", va="center")
    chart.plot(*path[0], "s", color=INK, ms=5)
    bare(chart)
    distance.axhline(0.0, color=FORBIDDEN, lw=1.2)
    distance.set(ylim=(-22, 110), xlabel="time (s)", ylabel="distance to the nearest hazard (cm)")
    distance.legend(loc="upper right")
    return figure
