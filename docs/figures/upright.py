"""HalfCheetah thrown about by random torques: the tilt of its torso, limited and not."""

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _drivers import bang_bang, drive
from _style import FORBIDDEN, OFF, ON, panels

TILT = 0.7


def draw() -> Figure:
    """Tilt over time; steps that were flagged infeasible are marked."""
    figure, ax = panels(height=2.8)
    upright = sw.constraints.Upright("torso", tilt=TILT, margin=0.02, horizon=5)
    raw = gym.make("HalfCheetah-v5")
    filtered = sw.CBFActionFilter(gym.make("HalfCheetah-v5"), [upright])
    for env, color, name in ((raw, OFF, "unfiltered"), (filtered, ON, "filtered")):
        tilt, infos = drive(
            env,
            bang_bang(1.0, 0.1),
            150,
            lambda raw, info: np.arccos(np.clip(raw.data.body("torso").xmat[8], -1, 1)),
        )
        time = np.arange(len(tilt)) * 0.05
        flagged = np.array([i.get("cbf/infeasible", False) for i in infos])
        ax.plot(time, tilt, color=color, label=name)
        if flagged.any():
            ax.plot(time[flagged], tilt[flagged], "o", color=color, ms=4, label="flagged infeasible")
    ax.axhline(TILT, color=FORBIDDEN, lw=1.2)
    ax.set(xlabel="time (s)", ylabel="tilt of the torso (rad)")
    ax.legend(loc="center right")
    return figure
