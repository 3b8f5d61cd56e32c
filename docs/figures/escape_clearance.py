"""Nine ways out of a place on the road, and the boxes of where the cars may be by then."""

import math
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyBboxPatch

import safe_wrappers as sw
from _crossing import road, tracked
from _style import FORBIDDEN, OFF, ON, SAFE, panels
from safe_wrappers.control.backup.evasive_maneuvers import ways
from safe_wrappers.plants.mujoco.planar_point import planar_point

LAYOUT = {
    "agent": [-0.2, -2.2, math.pi / 2],
    "goal": [1.6, 2.9],
    "cars": [[-2.6, 1.0], [-7, 1], [-9, 1.0], [3.0, -1.0], [5, -1], [9, -1]],
    "pillars": [[-1.7, -2.1], [1.3, -2.1], [-1.5, 2.2], [0.9, 2.2]],
}
WALKED = 12
"""Steps."""
SHOWN_S = (0.0, 1.2, 2.4)


def draw() -> Figure:
    """The robot on its way over the road."""
    env = tracked()
    env.reset(seed=4, options={"layout": LAYOUT})
    for _ in range(WALKED):
        env.step(np.array([0.0, 1.0, 0.0]))
    plant = sw.MujocoPlant()
    plant.bind(env)
    plant.observe()
    figure, ax = panels(height=4.2)
    road(ax, env)
    raw: Any = env.unwrapped
    discs = sw.constraints.TrackedDiscs(raw.car_radius)
    centers, halves = discs.boxes(plant, np.array(SHOWN_S))
    for late in range(len(SHOWN_S)):
        for center, half in zip(centers[late], halves[late], strict=True):
            corner, size = center - half, 2.0 * half
            pad = f"round,pad={raw.car_radius}"
            ax.add_patch(FancyBboxPatch(corner, *size, boxstyle=pad, color=FORBIDDEN, alpha=0.12, lw=0))
    point = planar_point(plant, np.inf, "robot")
    directions = [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)]
    controls = np.array([(0.0, 0.0), *np.repeat(directions, 2, axis=0)])
    going = np.array([0, *(round(s / plant.control_dt) for s in (0.3, 0.8) * 4)])
    instants = np.arange(0, round(2.4 / plant.control_dt) + 1)
    found = ways(point.axes, raw.agent_position, raw.agent_velocity, controls, going, instants)
    times = plant.control_dt * instants
    centers, halves = discs.boxes(plant, times)
    for way in found:
        (along, across), place = way.T, way[:, None]
        gap = np.linalg.norm(np.maximum(np.abs(place - centers) - halves, 0.0), axis=2)
        free = bool((gap - raw.car_radius - raw.robot_radius).min() >= 0.05)
        ax.plot(along, across, color=SAFE if free else OFF, ls="-" if free else "--")
        ax.add_patch(
            Circle((along[-1], across[-1]), raw.robot_radius, fill=False, edgecolor=SAFE if free else OFF)
        )
    for center in raw.car_positions:
        if abs(center[0]) < 4.4:
            ax.add_patch(Circle(center, raw.car_radius, fill=False, edgecolor=ON, lw=1.6))
    ax.set_ylim(-3.2, 2.8)
    return figure
