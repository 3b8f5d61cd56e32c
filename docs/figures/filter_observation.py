"""What a learner sees of the hazards around it: the task's lidar, and the filter's own view."""

from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _style import INK, OFF, ON, disc, panels
from first_look import LAYOUT

BINS = 16


def draw() -> Figure:
    """Left: the scene, with a line to each hazard that is shown. Right: lidar and features over the bearing."""
    figure, (chart, bearing) = panels(2, height=3.0, width_ratios=[4, 5])
    env = sw.FilterObservation(sw.protect(gym.make("SafePointGoal1-v0")), neighbours=4)
    layout = {**LAYOUT, "agent": [-0.35, -0.55, 0.6]}
    observation, _ = env.reset(seed=0, options={"layout": layout})
    task: Any = env.unwrapped
    shown = observation[62:78].reshape(4, 4)
    lidar = observation[28:44]
    for center in task.hazard_positions:
        disc(chart, center, task.hazard_radius)
    place, heading = task.agent_position, task.agent_heading
    turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
    for ahead, left, squashed, _ in shown:
        way = turn @ [ahead, left] * squashed / (1.0 - squashed)
        chart.plot(*np.transpose([place, place + way]), color=ON, lw=1.5)
    chart.plot(*place, "o", color=INK, ms=6)
    chart.plot(*np.transpose([place, place + 0.15 * turn[:, 0]]), color=INK, lw=2.5)
    chart.set(aspect="equal", xlabel="x (m)", ylabel="y (m)")
    edges = np.degrees(np.linspace(0.0, 2.0 * np.pi, BINS + 1))
    bearing.stairs(lidar, edges, color=OFF, label="hazard lidar, 16 bins")
    angles = np.degrees(np.arctan2(shown[:, 1], shown[:, 0])) % 360.0
    bearing.vlines(angles, 0.0, 1.0 - shown[:, 2], color=ON, lw=2.5, label="the filter's: 1 - clearance")
    bearing.set(xlabel="bearing from the heading (degrees)", ylabel="reading", ylim=(0.0, 1.3))
    bearing.legend(loc="upper right")
    return figure
