"""The continuous condition, asked at samples only, against the bound for a held control."""

import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _cart import run, wall
from _style import FORBIDDEN, GRID, OFF, ON, panels
from safe_wrappers.filter.constraint import Constraint

WALL, GAMMA = 1.0, 2.0


class ContinuousRow(Constraint):
    """(a / v) (gamma h - v), the textbook's row, evaluated at the samples."""

    def rows(self) -> sw.HalfSpaces:
        """One half-space on the acceleration; nothing at standstill."""
        x, v = self.plant.state
        limit = max((GAMMA * (WALL - x - v**2 / 2.0) - v) / v, -1.0) if v > 0.0 else float(x < WALL)
        return sw.HalfSpaces(np.array([[1.0]]), np.array([limit]))


def draw() -> Figure:
    """Left: the distance left. Right: the executed control, held between the dots."""
    figure, (distance, commands) = panels(2, height=3.0)
    dt = 0.25
    for constraint, color, name in (
        (ContinuousRow(), OFF, "continuous condition"),
        (wall(WALL), ON, "held control"),
    ):
        loop = run(dt, 20, constraint)
        distance.plot(loop.t, 1000 * (WALL - loop.x), color=color, label=name)
        distance.plot(loop.t[::20], 1000 * (WALL - loop.x[::20]), "o", color=color, ms=3.5)
        commands.step(np.arange(len(loop.u)) * dt, loop.u, where="post", color=color)
    distance.axhline(0.0, color=FORBIDDEN, lw=1.2)
    distance.set(ylim=(-150, 400), xlabel="time (s)", ylabel="distance to the wall (mm)")
    distance.legend(loc="upper right")
    commands.axhline(0.0, color=GRID, lw=0.8)
    commands.set(xlabel="time (s)", ylabel="executed acceleration (m/s²)")
    return figure
