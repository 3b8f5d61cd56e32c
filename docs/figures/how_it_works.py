"""One control step: the trajectories of four controls, and which of them the requirement admits."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch

from _style import FORBIDDEN, GRID, INK, OFF, ON, SAFE, panels

WALL, BRAKE, HOLD = 2.0, 1.0, 0.5


def way(x: float, v: float, control: float) -> tuple[np.ndarray, np.ndarray]:
    """Times and positions: the control held, then braking to rest."""
    times, places = [0.0], [x]
    for k in range(400):
        push = control if k < HOLD / 0.01 else -min(BRAKE, max(v, 0.0) / 0.01)
        v = max(v + 0.01 * push, 0.0)
        x += 0.01 * v
        times.append(0.01 * (k + 1))
        places.append(x)
    return np.array(times), np.array(places)


def draw() -> Figure:
    """Left: where controls lead. Right: who asks whom."""
    figure, (ways, house) = panels(2, height=3.3, width_ratios=[3, 5])
    ways.axhline(WALL, color=FORBIDDEN, lw=2)
    ways.axvline(HOLD, color=GRID, lw=0.8, ls=":")
    controls = (1.0, OFF, "proposed", 2.45), (0.3, ON, "executed", 1.87), (-1.0, SAFE, "backup", 0.93)
    for control, color, name, below in controls:
        times, places = way(0.0, 1.4, control)
        ways.plot(times, places, color=color)
        ways.text(3.1, below, name, color=color, ha="right", va="top")
    ways.text(HOLD - 0.04, -0.16, "held", color=INK, ha="right")
    ways.text(HOLD + 0.06, -0.16, "then braking, to rest", color=INK)
    ways.text(0.05, WALL + 0.06, "h = 0", color=FORBIDDEN)
    ways.set(xlim=(0.0, 3.2), ylim=(-0.25, 2.6), xlabel="time (s)", ylabel="position (m)")
    for text, x, y, color in (
        ("policy", 0.0, 1.0, OFF),
        ("filter", 0.5, 1.0, ON),
        ("env", 1.0, 1.0, INK),
        ("constraints\nh_along(path)", 0.15, 0.0, FORBIDDEN),
        ("model\nrollout(control)", 0.85, 0.0, SAFE),
    ):
        frame = {"boxstyle": "round", "fc": "none", "ec": color}
        house.text(x, y, text, color=color, ha="center", va="center", bbox=frame)
    for start, end, text, at in (
        ((0.09, 1.0), (0.41, 1.0), "action", (0.25, 1.08)),
        ((0.59, 1.0), (0.93, 1.0), "admitted", (0.76, 1.08)),
        ((0.46, 0.85), (0.2, 0.22), "is it safe?", (0.14, 0.55)),
        ((0.54, 0.85), (0.8, 0.22), "where does it lead?", (0.92, 0.55)),
        ((0.63, 0.0), (0.36, 0.0), "path", (0.495, 0.06)),
    ):
        house.add_patch(FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=10, color=GRID, lw=1.0))
        house.text(*at, text, color=INK, ha="center", fontsize=8.5)
    house.set(xlim=(-0.1, 1.2), ylim=(-0.3, 1.3))
    house.axis("off")
    return figure
