"""TeleopContact from above: the tool's way to the wall and along it, and the force on the way; no channel."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from _style import FORBIDDEN, GRID, INK, ON, bare
from _teleop import STEP_S, episode
from safe_wrappers.envs.teleop_contact import CLAMP_Y, TOOL_RADIUS, WALL_X


def draw() -> Figure:
    """A map, and the force of the wall over time."""
    seen = episode(0.0, 6.0, (0.05, -0.02))
    figure = Figure(figsize=(7.2, 3.2))
    plane, force = figure.subplots(1, 2, width_ratios=[1.0, 1.4])
    plane.add_patch(Rectangle((WALL_X, -0.08), 0.05, 0.4, color=GRID, alpha=0.4, lw=0))
    plane.add_patch(Rectangle((-0.05, CLAMP_Y), WALL_X + 0.05, 0.04, color=FORBIDDEN, alpha=0.4, lw=0))
    plane.plot(seen["x"], seen["y"], color=ON)
    for k in (0, -1):
        plane.add_patch(Circle((seen["x"][k], seen["y"][k]), TOOL_RADIUS, color=ON, alpha=0.5, lw=0))
    plane.text(0.225, 0.1, "wall", color=INK, rotation=90, ha="center", va="center")
    plane.text(0.07, CLAMP_Y + 0.02, "clamp", color=INK, ha="center", va="center")
    plane.set(xlim=(-0.05, 0.25), ylim=(-0.08, 0.3))
    bare(plane)
    force.plot(STEP_S * np.arange(len(seen["x"])), seen["contact_force"], color=ON)
    force.axhline(8.0, color=GRID, lw=1.0)
    force.text(0.1, 8.2, "wanted", color=GRID)
    force.set(xlabel="time (s)", ylabel="force of the wall (N)")
    return figure
