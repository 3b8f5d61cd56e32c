"""Reacher's joint speeds under random torques, limited and not."""

from typing import Any

import gymnasium as gym
import numpy as np
from _style import FORBIDDEN, OFF, ON, panels
from matplotlib.figure import Figure
from numpy.typing import NDArray

import safe_wrappers as sw

LIMIT = 5.0


def drive(env: Any) -> NDArray[np.float64]:
    """Speeds of both joints at the ends of the control steps, shape (k, 2)."""
    rng = np.random.default_rng(1)
    env.reset(seed=0)
    speeds, action = [], np.zeros(2, dtype=np.float32)
    for step in range(250):
        if step % 20 == 0:
            action = rng.choice([-0.12, 0.12], size=2).astype(np.float32)
        env.step(action)
        speeds.append(env.unwrapped.data.qvel[:2].copy())
    return np.array(speeds)


def draw() -> Figure:
    """One panel per joint."""
    figure, axes = panels(2, height=2.8, sharey=True)
    make = "Reacher-v5"
    off = drive(gym.make(make, max_episode_steps=1000))
    limit = sw.JointSpeedLimit(limit=LIMIT, margin=0.01)
    on = drive(sw.CBFActionFilter(gym.make(make, max_episode_steps=1000), [limit]))
    for j, ax in enumerate(axes):
        time = np.arange(len(off)) * 0.02
        ax.plot(time, off[:, j], color=OFF, lw=1.1, label="unfiltered")
        ax.plot(time, on[:, j], color=ON, lw=1.4, label="filtered")
        for side in (-LIMIT, LIMIT):
            ax.axhline(side, color=FORBIDDEN, lw=1.2)
        ax.set_xlabel("time (s)")
        ax.set_title(f"joint {j}", fontweight="normal")
    axes[0].set_ylabel("speed (rad/s)")
    axes[0].legend(loc="lower left")
    return figure
