"""How a robot that cannot brake sideways comes to rest."""

import math

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _style import INK, ON, OTHER, SAFE, bare, disc, panels
from safe_wrappers.control.backup.heading_drive import way_to_rest
from safe_wrappers.errors import Array

HEADING, SPEED = 0.7, 1.3


def braking(uncertainty: float) -> list[Array]:
    """The robot slides along x with its nose turned and brakes until it rests: its path, and those at the corners."""
    env = gym.make("SafePointGoal1-v0")
    constraint = sw.constraints.HeadingDriveClearance([sw.constraints.Disc((5.0, 5.0), 0.2)])
    filtered = sw.CBFActionFilter(env, [constraint])
    filtered.reset(seed=0, options={"layout": {"agent": [0.0, 0.0, HEADING], "hazards": [], "vases": []}})
    drive = filtered.filter.bound[0].spec.drive  # type: ignore[attr-defined]
    start = np.array([0.0, 0.0, HEADING, SPEED, 0.0, 0.0])
    return [way_to_rest(body, start) for body in (drive, *drive.corners(uncertainty))]


def draw() -> Figure:
    """Left: certain. Right: mass and damping uncertain by a quarter."""
    figure, axes = panels(2, height=2.5)
    for ax, uncertainty in zip(axes, (0.0, 0.25), strict=True):
        path, *others = braking(uncertainty)
        for other in others:
            ax.plot(*other.T, color=SAFE, lw=1.0)
        ax.plot(*path.T, color=ON)
        ax.plot(*path[-1], "o", color=ON, ms=4)
        ax.annotate("", (0.22, 0.0), (0.0, 0.0), arrowprops={"arrowstyle": "-|>", "color": OTHER})
        ax.text(0.24, 0.0, "motion", color=OTHER, va="center")
        nose = (0.16 * math.cos(HEADING), 0.16 * math.sin(HEADING))
        ax.annotate("", nose, (0.0, 0.0), arrowprops={"arrowstyle": "-|>", "color": INK})
        ax.text(nose[0], nose[1] + 0.04, "heading", color=INK, ha="center", va="center")
        ax.plot(0.0, 0.0, "s", color=INK, ms=5)
        disc(ax, (0.72, 0.12), 0.2)
        bare(ax)
        ax.set(xlim=(-0.1, 1.0), ylim=(-0.58, 0.34))
    return figure
