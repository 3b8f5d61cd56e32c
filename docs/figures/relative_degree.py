"""A position check on a plant with inertia brakes too late; a braking distance in h does not."""

import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _cart import run, wall
from _style import FORBIDDEN, GRID, OFF, ON, SAFE, panels
from safe_wrappers.control.backup.stopping import held_stop
from safe_wrappers.filter.constraint import Constraint

WALL = 2.0


class NextPosition(Constraint):
    """The naive rule: any control whose next position is still left of the wall."""

    def rows(self) -> sw.HalfSpaces:
        """X + v hold + u hold^2 / 2 <= wall."""
        (x, v), hold = self.plant.state, self.plant.control_dt
        return sw.HalfSpaces(np.array([[0.5 * hold**2]]), np.array([WALL - x - v * hold]))


def draw() -> Figure:
    """Left: paths in the plane of position and speed. Right: what was executed."""
    figure, (plane, commands) = panels(2, height=3.1, width_ratios=[3, 2])
    speed = np.linspace(0.0, 2.2, 200)
    inset = WALL - np.array([held_stop(v, 1.0, 0.1) for v in speed])
    plane.fill_betweenx(speed, -0.2, inset, color=SAFE, alpha=0.15, lw=0)
    plane.plot(inset, speed, color=SAFE, lw=1.2)
    plane.text(-0.16, 1.0, "from here it\ncan still stop", color=SAFE)
    plane.axvline(WALL, color=FORBIDDEN, lw=2)
    plane.text(WALL + 0.05, 0.1, "wall", color=FORBIDDEN)
    for constraint, color in ((NextPosition(), OFF), (wall(WALL), ON)):
        loop = run(0.1, 45, constraint)
        plane.plot(loop.x, loop.v, color=color)
        commands.step(np.arange(len(loop.u)) * 0.1, loop.u, where="post", color=color)
    plane.text(2.5, 1.85, "checks the next\nposition only", color=OFF)
    plane.text(0.68, 0.55, "counts the\nbraking distance", color=ON)
    plane.set(xlim=(-0.2, 3.4), ylim=(0.0, 2.3), xlabel="position (m)", ylabel="speed (m/s)")
    commands.axhline(0.0, color=GRID, lw=0.8)
    commands.set(xlabel="time (s)", ylabel="executed acceleration (m/s²)")
    return figure
