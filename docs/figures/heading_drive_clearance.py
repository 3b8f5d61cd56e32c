"""The area in which a robot that cannot brake sideways comes to rest, and the way it really takes."""

import math
from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

import safe_wrappers as sw
from _style import FORBIDDEN, INK, ON, OTHER, SAFE, bare, panels
from safe_wrappers.control.backup.heading_drive import Motion, stopping_path
from safe_wrappers.errors import Array

HEADING, SPEED = 0.7, 1.3


def braking(detail: dict[str, Any]) -> tuple[Array, Any]:
    """The robot slides along x with its nose turned; the backup runs until it rests: positions and the area."""
    env = gym.make("SafePointGoal1-v0")
    task: Any = env.unwrapped
    constraint = sw.constraints.HeadingDriveClearance([sw.constraints.Disc((5.0, 5.0), 0.2)], **detail)
    filtered = sw.CBFActionFilter(env, [constraint])
    filtered.reset(seed=0, options={"layout": {"agent": [0.0, 0.0, HEADING], "hazards": [], "vases": []}})
    qvel = task.data.qvel.copy()
    qvel[:2] = SPEED, 0.0
    task.set_state(task.data.qpos.copy(), qvel)
    bound: Any = filtered.filter.bound[0]
    filtered.filter.observe()
    area = stopping_path(bound.spec.drive, Motion(*task.data.qpos[:3], *task.data.qvel[:3]))
    where = [task.agent_position]
    for _ in range(150):
        filtered.filter.observe()
        env.step(bound.backup())
        where.append(task.agent_position)
    return np.array(where), area


def draw() -> Figure:
    """Left: certain. Right: mass and damping uncertain by a quarter."""
    figure, axes = panels(2, height=2.5)
    for ax, uncertainty in zip(axes, (0.0, 0.25), strict=True):
        path, area = braking({"uncertainty": uncertainty})
        _area(ax, area)
        ax.plot(*path.T, color=ON)
        ax.plot(*path[-1], "o", color=ON, ms=4)
        ax.annotate("", (0.22, 0.0), (0.0, 0.0), arrowprops={"arrowstyle": "-|>", "color": OTHER})
        ax.text(0.24, 0.0, "motion", color=OTHER, va="center")
        nose = (0.16 * math.cos(HEADING), 0.16 * math.sin(HEADING))
        ax.annotate("", nose, (0.0, 0.0), arrowprops={"arrowstyle": "-|>", "color": INK})
        ax.text(nose[0], nose[1] + 0.04, "heading", color=INK, ha="center", va="center")
        ax.plot(0.0, 0.0, "s", color=INK, ms=5)
        ax.add_patch(Circle((0.72, 0.12), 0.2, color=FORBIDDEN, alpha=0.35, lw=0))
        bare(ax)
        ax.set(xlim=(-0.1, 1.0), ylim=(-0.58, 0.34))
    return figure


def _area(ax: Axes, path: Any) -> None:
    ahead, aside = np.array([path.ex, path.ey]), np.array([path.sx, path.sy])
    start = np.array([path.x, path.y])
    s, c, e = path.forward, path.crossing, path.sideways
    corners = [(0.0, 0.0), (s, c), (s, e), *([(0.0, e)] if path.spread else [])]
    points = [start + a * ahead + b * aside for a, b in corners]
    ax.add_patch(Polygon(points, color=SAFE, alpha=0.25, lw=0))
