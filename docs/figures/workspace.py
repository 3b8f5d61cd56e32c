"""The way of Reacher's fingertip, inside a box and around a disc."""

from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

import safe_wrappers as sw
from _drivers import bang_bang, drive, sides
from _style import FORBIDDEN, INK, bare, disc, panels

LOW, HIGH = (-0.15, -0.1), (0.22, 0.12)
DISC, RADIUS = (0.06, -0.1), 0.05


def draw() -> Figure:
    """Left: unfiltered. Right: filtered."""
    figure, axes = panels(2, height=3.0)
    inside = sw.constraints.Workspace(
        low=[*LOW, None],
        high=[*HIGH, None],
        keep_out=[sw.constraints.Disc(DISC, RADIUS)],
        bodies=["fingertip"],
        margin=0.003,
        horizon=8,
    )
    for ax, (env, color, _) in zip(axes, sides("Reacher-v5", inside), strict=True):
        path, _ = drive(
            env, bang_bang(0.1, 0.05), 400, lambda raw, info: raw.data.body("fingertip").xpos[:2].copy()
        )
        width, height = HIGH[0] - LOW[0], HIGH[1] - LOW[1]
        ax.add_patch(Rectangle(LOW, width, height, fill=False, ec=FORBIDDEN, lw=1.2))
        disc(ax, DISC, RADIUS)
        ax.plot(*path.T, color=color, lw=1.1)
        ax.plot(*path[0], "s", color=INK, ms=4)
        bare(ax)
        ax.set(xlim=(-0.24, 0.24), ylim=(-0.22, 0.22))
    return figure
