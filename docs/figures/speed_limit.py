"""HalfCheetah's speed under random full torques, limited and not."""

import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _drivers import bang_bang, drive, sides
from _style import FORBIDDEN, panels

LIMIT = 0.6


def draw() -> Figure:
    """Speed over the control step; steps that were flagged infeasible are marked."""
    figure, ax = panels(height=2.8)
    limit = sw.constraints.SpeedLimit(LIMIT, body="torso", direction="+x", margin=0.02)
    for env, color, name in sides("HalfCheetah-v5", limit):
        speed, infos = drive(env, bang_bang(1.0, 0.1), 200, lambda raw, info: info["x_velocity"])
        time = np.arange(len(speed)) * 0.05
        ax.plot(time, speed, color=color, lw=1.2, label=name)
        flagged = np.array([i.get("cbf/infeasible", False) for i in infos])
        if flagged.any():
            assert not ((speed > LIMIT) & ~flagged).any()  # what the caption says
            ax.plot(time[flagged], speed[flagged], "o", color=color, ms=4, label="flagged infeasible")
    ax.axhline(LIMIT, color=FORBIDDEN, lw=1.2)
    ax.set(xlabel="time (s)", ylabel="forward speed (m/s)")
    ax.legend(loc="lower right", ncols=3)
    return figure
