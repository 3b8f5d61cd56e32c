"""Two filters in a row against one projection on both rows."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle

import safe_wrappers as sw
from _style import FORBIDDEN, GRID, INK, OFF, ON, OTHER, SAFE, panels

ROWS = np.array([[-0.6, 1.0], [1.0, 0.15]])
OFFSETS = np.array([0.15, -0.05])
LOW, HIGH = np.full(2, -1.0), np.full(2, 1.0)


def draw() -> Figure:
    """The admitted corner, where the second layer leaves the first row, and what one projection gives."""
    figure, ax = panels(width=4.6, height=3.6)
    corner = np.linalg.solve(ROWS, OFFSETS)
    left = [-1.0, (OFFSETS[0] + ROWS[0, 0]) / ROWS[0, 1]]
    below = [(OFFSETS[1] + ROWS[1, 1]) / ROWS[1, 0], -1.0]
    ax.add_patch(Polygon([[-1, -1], left, corner, below], color=SAFE, alpha=0.2, lw=0))
    ax.add_patch(Rectangle((-1, -1), 2, 2, fill=False, ec=GRID, ls="--"))
    for row, offset, name, at in zip(ROWS, OFFSETS, "AB", ((1.12, 0.98), (0.0, 1.12)), strict=True):
        along = np.array([-row[1], row[0]])
        foot = offset * row / (row @ row)
        ax.plot(*np.array([foot - 3 * along, foot + 3 * along]).T, color=FORBIDDEN, lw=1.2)
        ax.text(*at, name, color=FORBIDDEN, weight="bold", ha="center", va="center")
    nominal = np.array([0.3, 0.95])
    first = sw.project(nominal, ROWS[:1], OFFSETS[:1], LOW, HIGH).control
    second = sw.project(first, ROWS[1:], OFFSETS[1:], LOW, HIGH).control
    both = sw.project(nominal, ROWS, OFFSETS, LOW, HIGH).control
    assert ROWS[0] @ second > OFFSETS[0] + 0.01  # the second layer has undone the first
    for start, end in ((nominal, first), (first, second)):
        ax.annotate("", end, start, arrowprops={"arrowstyle": "->", "color": OTHER, "ls": ":"})
    ax.annotate("", both, nominal, arrowprops={"arrowstyle": "-|>", "color": INK, "shrinkA": 4, "shrinkB": 4})
    ax.plot(*nominal, "o", color=OFF, ms=7)
    ax.plot(*second, "X", color=FORBIDDEN, ms=9)
    ax.plot(*both, "o", color=ON, ms=7)
    ax.text(0.38, 0.97, "policy's", color=OFF, va="center")
    ax.text(*(first + np.array([0.08, -0.02])), "A first", color=OTHER, va="center")
    ax.text(
        *(second + np.array([-0.09, 0.03])), "then B:\nbreaks A", color=FORBIDDEN, ha="right", va="bottom"
    )
    ax.text(*(both + np.array([0.12, -0.12])), "A and B in\none projection", color=ON, va="top")
    ax.set(xlim=(-1.3, 1.4), ylim=(-1.3, 1.15), aspect="equal", xlabel="$u_1$")
    ax.set_ylabel("$u_2$", rotation=0)
    ax.set(xticks=[-1, 0, 1], yticks=[-1, 0, 1])
    return figure
