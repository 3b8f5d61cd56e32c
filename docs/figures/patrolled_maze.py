"""The patrolled maze from above: a ball that goes where the patrols are, without the filter and with it."""

import contextlib
import io
from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

import safe_wrappers as sw
from _style import FORBIDDEN, INK, OFF, ON, OTHER, bare, panels

with contextlib.redirect_stderr(io.StringIO()):  # it greets on stderr
    import gymnasium_robotics  # noqa: F401

NOISE = 0.2725
STEPS = 400


def tracked() -> Any:
    """The env with its patrols tracked."""
    track = sw.occlusion.Track(
        published="patrol_positions",
        acceleration_noise=[NOISE, 0],
        reversion_s=2.0,
        start_position_std=[0.1, 0],
        start_velocity_std=[0.55, 0],
    )
    sensor = sw.occlusion.Sensor(site="particle_site", position_std=0.02)
    return sw.OcclusionPenalty(gym.make("PatrolledPointMaze-v0"), [track], sensor, tolerance=0.5)


def drive(env: Any) -> tuple[Any, int]:
    """The ball's way, straight at the nearest patrol, and collisions."""
    raw, where, collisions = env.unwrapped, [], 0
    cells = {"goal_cell": np.array([3, 1]), "reset_cell": np.array([2, 3])}
    env.reset(seed=5, options=cells)
    for _ in range(STEPS):
        where.append(raw.agent_position)
        offsets = raw.patrol_positions - raw.agent_position
        towards = np.clip(5.0 * offsets[np.hypot(*offsets.T).argmin()], -1.0, 1.0)
        collisions += env.step(towards.astype(np.float32))[4]["collisions"]
    return np.array(where), collisions


def draw() -> Figure:
    """Left: unfiltered. Right: filtered."""
    figure, axes = panels(2, height=3.4)
    sides = ((tracked(), OFF, "unfiltered"), (sw.protect(tracked()), ON, "filtered"))
    for ax, (env, color, name) in zip(axes, sides, strict=True):
        path, collisions = drive(env)
        raw = env.unwrapped
        for geom in range(raw.model.ngeom):
            if raw.model.geom(geom).name.startswith("block"):
                center, half = raw.model.geom_pos[geom][:2], raw.model.geom_size[geom][:2]
                ax.add_patch(Rectangle(center - half, *(2 * half), color=FORBIDDEN, alpha=0.25, lw=0))
        ax.plot(*path.T, color=color, lw=1.2)
        ax.add_patch(Circle(path[-1], raw.ball_radius, color=INK, lw=0))
        for center, estimate, covariance in zip(
            raw.patrol_positions,
            env.get_wrapper_attr("tracking").positions,
            env.get_wrapper_attr("tracking").position_covariances,
            strict=True,
        ):
            ax.add_patch(Circle(center, raw.patrol_radius, color=OTHER, alpha=0.8, lw=0))
            reach = 3.0 * np.sqrt(covariance[0, 0])
            ax.plot(estimate[0] + np.array([-reach, reach]), [estimate[1]] * 2, color=OTHER, lw=1.2, ls=":")
        ax.set_title(f"{name}: collisions {collisions}", fontweight="normal")
        bare(ax)
    return figure
