"""Traction curves, and where on them a rover's wheels are under full throttle, limited and not."""

import numpy as np
from matplotlib.figure import Figure

from _rover import FULL_THROTTLE, rover
from _style import FORBIDDEN, INK, OFF, ON, panels
from safe_wrappers.envs.ground import MAGIC_FORMULA

GROUNDS = ("dry", "wet", "ice")
STEPS, FIRST, EVERY = 150, 20, 10


def draw() -> Figure:
    """The points of all four wheels, every tenth of a second from 0.2 to 1.5 s."""
    figure, ax = panels(1, height=3.4)
    slip = np.linspace(0.0, 1.0, 400)
    for ground in GROUNDS:
        curve = MAGIC_FORMULA[ground]
        ax.plot(slip, curve.friction(slip), color=INK, lw=1.2)
        around = [curve.peak_friction - 0.03, curve.peak_friction + 0.03]
        ax.plot(2 * [curve.peak_slip], around, color=FORBIDDEN, lw=1.2)
        ax.text(0.35, curve.at(0.35) + 0.025, ground)
        for limited, color, name in ((False, OFF, "limiter off"), (True, ON, "limiter on")):
            env = rover(limited, ground=ground)
            slips = [env.step(FULL_THROTTLE)[4]["slip"] for _ in range(STEPS)]
            points = np.concatenate(slips[FIRST - 1 :: EVERY])
            label = name if ground == GROUNDS[0] else None
            ax.plot(points, curve.friction(points), "o", color=color, ms=4, alpha=0.6, mew=0, label=label)
    ax.set(xlim=(0.0, 1.0), ylim=(0.0, 1.1), xlabel="slip ratio", ylabel="friction coefficient")
    ax.legend(loc="upper right")
    return figure
