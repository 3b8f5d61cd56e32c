"""Commands that act 0.2 s late: undeclared, and declared to the plant."""

from matplotlib.figure import Figure

from _cart import Cart, run, wall
from _style import FORBIDDEN, OFF, ON, panels

WALL = 2.0


def draw() -> Figure:
    """Distance to the wall over time."""
    figure, ax = panels(height=2.8)
    for delay, color, name in (
        (0.0, OFF, "the plant is not told: delay_s=0"),
        (0.2, ON, "the plant is told: delay_s=0.2"),
    ):
        loop = run(Cart((0.0, 0.0), dt=0.1, latency=2), 60, [wall(WALL)], delay_s=delay)
        ax.plot(loop.t, WALL - loop.x, color=color, label=name)
    ax.axhline(0.0, color=FORBIDDEN, lw=1.2)
    ax.text(0.05, -0.03, "wall", color=FORBIDDEN, va="top")
    ax.set(xlabel="time (s)", ylabel="distance to the wall (m)")
    ax.legend(loc="upper right")
    ax.set_ylim(-0.7, 2.05)
    return figure
