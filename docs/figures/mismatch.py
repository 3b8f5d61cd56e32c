"""What a braking bound that is too good costs, and what one that is too careful costs."""

import numpy as np
from matplotlib.figure import Figure

from _cart import run, wall
from _style import FORBIDDEN, GRID, OFF, ON, panels

WALL = 2.0
NEAR_M = 0.05


def draw() -> Figure:
    """Closest approach to the wall, and the time until the cart is near it, over declared / true braking."""
    figure, (depth, time) = panels(2, height=2.8)
    ratios = np.linspace(0.4, 1.6, 25)
    closest, times = [], []
    for ratio in ratios:
        loop = run(0.1, 60, wall(WALL, braking=ratio))
        closest.append(1000 * (WALL - loop.x.max()))
        times.append(loop.t[np.argmax(loop.x > WALL - NEAR_M)])
    depth.plot(ratios, closest, color=ON)
    depth.fill_between(ratios, np.minimum(closest, 0.0), 0.0, color=FORBIDDEN, alpha=0.25, lw=0)
    depth.axhline(0.0, color=FORBIDDEN, lw=1.2)
    depth.text(0.42, -12, "wall", color=FORBIDDEN, va="top")
    depth.set_ylabel("closest approach (mm)")
    time.plot(ratios, times, color=OFF)
    time.set_ylabel("time to within 5 cm (s)")
    for ax in (depth, time):
        ax.axvline(1.0, color=GRID, lw=0.8, ls="--")
        ax.set_xlabel("declared / true braking")
    return figure
