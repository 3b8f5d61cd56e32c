"""A speed limit as a barrier: what the row allows, and how alpha shapes the approach."""

import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _cart import Cart, run
from _style import FORBIDDEN, OFF, ON, OTHER, SAFE, panels

LIMIT = 1.0
ALPHAS = {0.5: OTHER, 2.0: ON, 10.0: OFF}


def draw() -> Figure:
    """Left: the largest admitted acceleration over speed. Right: speed under full throttle."""
    figure, (row, loop) = panels(2, height=2.9)
    speed = np.linspace(0.0, 1.25, 100)
    for alpha, color in ALPHAS.items():
        admitted = np.clip(alpha * (LIMIT - speed), -1.0, 1.0)
        row.plot(speed, admitted, color=color, label=f"alpha = {alpha:g}/s")
        limit = sw.constraints.Barrier(lambda x: LIMIT - x[1], alpha=alpha)
        driven = run(Cart((0.0, 0.0), dt=0.1), 50, [limit])
        loop.plot(driven.t, driven.v, color=color)
    row.fill_between(speed, -1.0, np.clip(2.0 * (LIMIT - speed), -1.0, 1.0), color=SAFE, alpha=0.15, lw=0)
    row.axvline(LIMIT, color=FORBIDDEN, lw=1.2)
    row.set(xlabel="speed (m/s)", ylabel="admitted acceleration up to (m/s²)")
    row.legend(loc="lower left")
    loop.axhline(LIMIT, color=FORBIDDEN, lw=1.2)
    loop.text(0.05, LIMIT + 0.01, "limit", color=FORBIDDEN, va="bottom")
    loop.set(ylim=(0.0, 1.15), xlabel="time (s)", ylabel="speed (m/s)")
    return figure
