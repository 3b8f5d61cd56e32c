"""OccludedCrossing with its cars tracked, and how it is drawn from above."""

import math
from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon, Rectangle

import safe_wrappers as sw
from _style import FORBIDDEN, GRID, INK, OFF, bare
from safe_wrappers.envs.traffic import CAR_ACCELERATION_NOISE, CAR_TIME_CONSTANT_S

STEP_S = 0.04
TOLERANCE_M, SHADOW_M = 0.5, 12.0


def tracked(*bodies: str) -> Any:
    """The env with these cars tracked, all by default; the first three drive towards +x."""
    tracks = [
        sw.occlusion.Track(
            name,
            acceleration_noise=[CAR_ACCELERATION_NOISE, 0.0],
            reversion_s=CAR_TIME_CONSTANT_S,
            mean_velocity=[1.0 if name[3:].strip("[]")[0] in "012" else -1.0, 0.0],
            start_position_std=[0.3, 0.0],
            start_velocity_std=[0.15, 0.0],
        )
        for name in bodies or ("car[012]", "car[345]")
    ]
    eye = sw.occlusion.Sensor(camera="eye", view_deg=100, range_m=9, position_std=0.05)
    return sw.OcclusionPenalty(gym.make("OccludedCrossing-v0"), tracks, eye, tolerance=TOLERANCE_M)


def turn_to(env: Any, heading: float) -> float:
    """A torque that turns the robot to a heading."""
    off = math.remainder(heading - env.unwrapped.agent_heading, math.tau)
    return float(np.clip(2.0 * off - 0.15 * env.unwrapped.data.qvel[2], -1.0, 1.0))


def road(ax: Axes, env: Any) -> None:
    """Road, pillars with what they hide, and the robot."""
    raw = env.unwrapped
    ax.add_patch(Rectangle((-4.4, -1.3), 8.8, 2.6, color=GRID, alpha=0.18, lw=0))
    ax.plot([-4.4, 4.4], [0, 0], color=GRID, lw=0.9, ls=(0, (8, 6)))
    eye = raw.data.cam("eye").xpos[:2]
    for center in raw.pillar_positions:
        way = center - eye
        distance, angle = math.hypot(*way), math.atan2(way[1], way[0])
        half = math.asin(raw.pillar_radius / distance)
        ends = [
            eye + length * np.array([math.cos(angle + side * half), math.sin(angle + side * half)])
            for side, length in ((1, distance), (1, SHADOW_M), (-1, SHADOW_M), (-1, distance))
        ]
        ax.add_patch(Polygon(ends, color=OFF, alpha=0.13, lw=0))
        ax.add_patch(Circle(center, raw.pillar_radius, color=INK, alpha=0.55, lw=0))
    ax.add_patch(Circle(raw.agent_position, raw.robot_radius, color=FORBIDDEN, lw=0))
    ax.set_xlim(-4.4, 4.4)
    bare(ax)
