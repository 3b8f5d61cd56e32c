"""A clumsy Ant: by how much its worst contact force leaves the cone at each step, without the filter and with it."""

import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _ant import STEP_S, walk
from _style import FORBIDDEN, INK, OFF, ON, panels

STEPS, SHARE = 100, 0.7


def draw() -> Figure:
    """Top: the excess over the cone. Bottom: the correction, and the steps that are flagged infeasible."""
    off, _, way_off = walk(lambda env: env, STEPS)
    on, infos, way_on = walk(sw.WholeBodyFilter, STEPS)
    times = STEP_S * np.arange(1, STEPS + 1)
    figure, (above, below) = panels(rows=2, height=4.2, sharex=True)
    flagged = np.array([info["cbf/infeasible"] for info in infos])
    for forces, color, label in (
        (off, OFF, f"filter off: {way_off:.1f} m"),
        (on, ON, f"filter on: {way_on:.1f} m"),
    ):
        excess = [max((f[:, 1] - SHARE * f[:, 0]).max(initial=0.0), 0.0) for f in forces]
        above.plot(times, excess, color=color, label=label)
    above.axhline(0.01, color=FORBIDDEN, lw=1.0)
    below.plot(times, [info["cbf/correction"] for info in infos], color=ON)
    for ax in (above, below):
        ax.fill_between(times, 0.0, 5.0, where=flagged, color=FORBIDDEN, alpha=0.15, lw=0, step="mid")
    above.set_ylim(0.0, 3.5)
    below.set_ylim(0.0, 4.5)
    above.set_ylabel("force beyond its cone\n(shares of the weight)")
    below.set(ylabel="correction of the torques", xlabel="time (s)")
    above.legend(loc="upper right")
    below.text(0.05, 4.0, "shaded: flagged infeasible", color=INK)
    return figure
