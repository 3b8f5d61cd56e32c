"""The way of PointMaze's point under random full forces, among walls."""

import contextlib
import io
from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

import safe_wrappers as sw
from _drivers import bang_bang, sides
from _style import FORBIDDEN, INK, bare, panels
from safe_wrappers.errors import Array

with contextlib.redirect_stderr(io.StringIO()):  # it greets on stderr
    import gymnasium_robotics

gym.register_envs(gymnasium_robotics)


def drive(env: Any) -> tuple[Array, int]:
    """Positions, and the steps in which the point touches a wall."""
    raw = env.unwrapped
    robot = raw.point_env
    env.reset(seed=4, options={"goal_cell": np.array([3, 1]), "reset_cell": np.array([1, 1])})
    driver, where, touching = bang_bang(1.0, 0.06, seed=2), [], 0
    for _ in range(400):
        where.append(robot.data.qpos[:2].copy())
        env.step(driver(env))
        touched = {robot.model.geom(g).name for pair in robot.data.contact.geom for g in pair}
        touching += any(name.startswith("block") for name in touched)
    return np.array(where), touching


def draw() -> Figure:
    """Left: unfiltered. Right: filtered."""
    figure, axes = panels(2, height=3.2)
    limit = sw.constraints.WallClearance(velocity_clip=5.0)
    for ax, (env, color, name) in zip(axes, sides("PointMaze_UMaze-v3", limit), strict=True):
        path, touching = drive(env)
        model = env.unwrapped.point_env.model
        for geom in range(model.ngeom):
            if model.geom(geom).name.startswith("block"):
                center, half = model.geom_pos[geom][:2], model.geom_size[geom][:2]
                ax.add_patch(Rectangle(center - half, *(2 * half), color=FORBIDDEN, alpha=0.25, lw=0))
        ax.plot(*path.T, color=color, lw=1.3)
        ax.plot(*path[0], "s", color=INK, ms=5)
        ax.set_title(f"{name}: {touching} of 400 steps in contact", fontweight="normal")
        bare(ax)
    return figure
