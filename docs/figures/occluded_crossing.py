"""The crossing from above: what the robot's camera sees of the cars, and what pillars hide."""

import math
from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle

import safe_wrappers  # noqa: F401 (registers the env)
from _style import FORBIDDEN, GRID, INK, OFF, ON, SAFE, bare, panels

HALF_VIEW = math.radians(50.0)
REACH = 12.0


def draw() -> Figure:
    """One start; every part in its true size."""
    env: Any = gym.make("OccludedCrossing-v0").unwrapped
    layout = {
        "agent": [-0.4, -2.9, math.pi / 2],
        "goal": [1.6, 2.9],
        "cars": [[-1.7, 1.0], [0.6, 1.0], [-8, 1], [2.4, -1.0], [-0.2, -1.0], [9, -1]],
        "pillars": [[-1.15, -1.9], [1.7, -1.9], [-1.5, 1.9], [0.9, 1.9]],
    }
    env.reset(seed=0, options={"layout": layout})
    figure, ax = panels(height=3.9)
    ax.add_patch(Rectangle((-4.4, -1.3), 8.8, 2.6, color=GRID, alpha=0.18, lw=0))
    ax.plot([-4.4, 4.4], [0, 0], color=GRID, lw=0.9, ls=(0, (8, 6)))
    for side in (-3.5, 3.5):
        ax.plot([-4, 4], [side, side], color=GRID, lw=1.2)
    eye, hidden = env.data.cam("eye").xpos[:2], _shadows(env, ax)
    for center, velocity in zip(env.car_positions, env.car_velocities[:, 0], strict=True):
        if abs(center[0]) < 4.0:
            color = OFF if _is_hidden(eye, center, hidden) else ON
            ax.add_patch(Circle(center, env.car_radius, color=color, alpha=0.8, lw=0))
            x, y = center
            ax.annotate("", (x + 1.1 * velocity, y), (x, y), arrowprops={"arrowstyle": "->", "color": INK})
    for center in env.pillar_positions:
        ax.add_patch(Circle(center, env.pillar_radius, color=INK, alpha=0.55, lw=0))
    ax.add_patch(Circle(env.goal_position, env.goal_radius, color=SAFE, alpha=0.5, lw=0))
    ax.add_patch(Circle(env.agent_position, env.robot_radius, color=FORBIDDEN, lw=0))
    for turn in (-HALF_VIEW, HALF_VIEW):
        end = eye + REACH * np.array([-math.sin(turn), math.cos(turn)])
        ax.plot(*np.transpose([eye, end]), color=GRID, lw=0.8, ls=":")
    for x, y, text, color in (
        (-0.1, -3.1, "robot, its camera ahead", FORBIDDEN),
        (1.95, 2.8, "goal", SAFE),
        (2.1, -2.3, "pillar", INK),
        (-3.2, -0.8, "hidden", OFF),
        (1.8, -0.8, "seen", ON),
    ):
        ax.text(x, y, text, color=color, va="center")
    ax.set(xlim=(-4.4, 4.4), ylim=(-3.6, 3.6))
    bare(ax)
    return figure


def _shadows(env: Any, ax: Axes) -> list[tuple[float, float, float]]:
    """Draws what each pillar hides from the eye; direction, half angle and distance of each."""
    eye = env.data.cam("eye").xpos[:2]
    found = []
    for center in env.pillar_positions:
        way = center - eye
        distance, angle = np.hypot(*way), math.atan2(way[1], way[0])
        half = math.asin(env.pillar_radius / distance)
        near = math.sqrt(distance**2 - env.pillar_radius**2)
        corners = [
            eye + length * np.array([math.cos(angle + side * half), math.sin(angle + side * half)])
            for side, length in ((1, near), (1, REACH), (-1, REACH), (-1, near))
        ]
        ax.add_patch(Polygon(corners, color=OFF, alpha=0.13, lw=0))
        found.append((angle, half, distance))
    return found


def _is_hidden(eye: Any, center: Any, shadows: list[tuple[float, float, float]]) -> bool:
    """Whether a pillar stands on the way to the car's centre."""
    angle, distance = math.atan2(*(center - eye)[::-1]), np.hypot(*(center - eye))
    return any(abs(math.remainder(angle - a, math.tau)) < half and distance > far for a, half, far in shadows)
