"""Reacher's joint speeds under random torques, limited and not."""

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _drivers import bang_bang, drive
from _style import FORBIDDEN, OFF, ON, panels

LIMIT = 5.0


def draw() -> Figure:
    """One panel per joint."""
    figure, axes = panels(2, height=2.8, sharey=True)
    raw = gym.make("Reacher-v5").unwrapped
    limited = sw.CBFActionFilter(
        gym.make("Reacher-v5").unwrapped, [sw.constraints.JointSpeedLimit(limit=LIMIT, margin=0.01)]
    )
    for env, color, name in ((raw, OFF, "unfiltered"), (limited, ON, "filtered")):
        speeds, _ = drive(env, bang_bang(0.12, 0.05, seed=1), 250, lambda raw, info: raw.data.qvel[:2].copy())
        for j, ax in enumerate(axes):
            ax.plot(np.arange(len(speeds)) * 0.02, speeds[:, j], color=color, lw=1.3, label=name)
    for j, ax in enumerate(axes):
        for side in (-LIMIT, LIMIT):
            ax.axhline(side, color=FORBIDDEN, lw=1.2)
        ax.set_xlabel("time (s)")
        ax.set_title(f"joint {j}", fontweight="normal")
    axes[0].set_ylabel("speed (rad/s)")
    axes[0].legend(loc="lower left")
    return figure
