"""Contact forces of a clumsy Ant in the cone's own plane: pressure and what is asked of friction."""

import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _ant import walk
from _style import FORBIDDEN, GRID, INK, OFF, ON, panels

STEPS, SHARE = 60, 0.7


def draw() -> Figure:
    """Left without, right with the constraint; steps that are flagged infeasible are hollow."""
    figure, (left, right) = panels(2, height=3.4, sharex=True, sharey=True)
    for ax, color, title, wrap in (
        (left, OFF, "filter off", lambda env: env),
        (right, ON, "filter on", lambda env: sw.CBFActionFilter(env, [sw.constraints.ContactFeasibility()])),
    ):
        forces, infos, _ = walk(wrap, STEPS)
        for found, info in zip(forces, infos, strict=True):
            flagged = info.get("cbf/infeasible", False)
            ax.scatter(*found.T, s=7, lw=0.5, color=color, facecolor="none" if flagged else color)
        press = np.array([0.0, 2.5])
        ax.plot(press, SHARE * press, color=FORBIDDEN, lw=1.2)
        ax.plot(press, press, color=GRID, lw=1.0, ls="--")
        ax.set(title=title, xlabel="pressure (shares of the weight)")
    left.set_ylabel("sideways force\n(shares of the weight)")
    left.text(1.5, 1.75, "the model's friction", color=INK, rotation=44, ha="center", va="center")
    left.text(1.75, 1.02, "0.7 of it", color=FORBIDDEN, rotation=35, ha="center", va="center")
    left.set(xlim=(0.0, 2.2), ylim=(0.0, 2.0))
    return figure
