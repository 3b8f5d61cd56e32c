"""The goal task with a driver that is blind to hazards, with the filter and without."""

import math
from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray

import safe_wrappers as sw
from _style import FORBIDDEN, INK, OFF, ON, SAFE, bare, panels

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


def drive(env: Any) -> tuple[NDArray[np.float64], float]:
    """Positions until the goal is reached, shape (k, 2), and the steps inside a hazard."""
    task = env.unwrapped
    env.reset(seed=0, options={"layout": LAYOUT})
    where, cost = [task.agent_position], 0.0
    for _ in range(1000):
        info = env.step(towards_goal(task))[4]
        where.append(task.agent_position)
        cost += info["cost_substep"]
        if info["goal_met"]:
            break
    return np.array(where), cost


def draw() -> Figure:
    """Left: the paths. Right: the distance to the nearest hazard."""
    figure, (chart, distance) = panels(2, height=3.0, width_ratios=[5, 4])
    for env, color, name in (
        (gym.make("SafePointGoal1-v0"), OFF, "unfiltered"),
        (sw.protect(gym.make("SafePointGoal1-v0")), ON, "filtered"),
    ):
        task: Any = env.unwrapped
        path, cost = drive(env)
        chart.plot(*path.T, color=color)
        gaps = np.linalg.norm(path[:, None] - task.hazard_positions, axis=2).min(axis=1) - task.hazard_radius
        label = f"{name}: {cost:.0f} steps in violation"
        distance.plot(np.arange(len(path)) * task.dt, 100.0 * gaps, color=color, label=label)
    for center in LAYOUT["hazards"]:
        chart.add_patch(Circle(center, task.hazard_radius, color=FORBIDDEN, alpha=0.35, lw=0))
    chart.add_patch(Circle(LAYOUT["goal"], task.goal_radius, fill=False, color=SAFE, lw=1.5))
    chart.text(*LAYOUT["goal"], "goal", color=SAFE, ha="center", va="center")
    chart.plot(*path[0], "s", color=INK, ms=5)
    bare(chart)
    distance.axhline(0.0, color=FORBIDDEN, lw=1.2)
    distance.set(ylim=(-22, 110), xlabel="time (s)", ylabel="distance to the nearest hazard (cm)")
    distance.legend(loc="upper right")
    return figure
