"""Two filters in a row against one projection on both rows."""

import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _style import FORBIDDEN, OFF, ON, OTHER, panels
from projection import HIGH, LOW, admitted, arrow, astray

ROWS = np.array([[-0.6, 1.0], [1.0, 0.15]])
OFFSETS = np.array([0.15, -0.05])


def draw() -> Figure:
    """The admitted corner, where the second layer leaves the first row, and what one projection gives."""
    figure, ax = panels(width=4.6, height=3.6)
    corner = np.linalg.solve(ROWS, OFFSETS)
    left = [-1.0, (OFFSETS[0] + ROWS[0, 0]) / ROWS[0, 1]]
    below = [(OFFSETS[1] + ROWS[1, 1]) / ROWS[1, 0], -1.0]
    admitted(ax, [[-1, -1], left, corner, below], ROWS, OFFSETS)
    for name, at in (("A", (1.12, 0.98)), ("B", (0.0, 1.12))):
        ax.text(*at, name, color=FORBIDDEN, weight="bold", ha="center", va="center")
    nominal = np.array([0.3, 0.95])
    first = sw.project(nominal, ROWS[:1], OFFSETS[:1], LOW, HIGH).control
    second = sw.project(first, ROWS[1:], OFFSETS[1:], LOW, HIGH).control
    assert ROWS[0] @ second > OFFSETS[0] + 0.01  # the second layer has undone the first
    astray(ax, nominal, first, second)
    both = arrow(ax, nominal, ROWS, OFFSETS)
    ax.text(0.38, 0.97, "policy's", color=OFF, va="center")
    ax.text(*(first + np.array([0.08, -0.02])), "A first", color=OTHER, va="center")
    ax.text(
        *(second + np.array([-0.09, 0.03])), "then B:\nbreaks A", color=FORBIDDEN, ha="right", va="bottom"
    )
    ax.text(*(both + np.array([0.12, -0.12])), "A and B in\none projection", color=ON, va="top")
    ax.set(xlim=(-1.3, 1.4), ylim=(-1.3, 1.15))
    return figure
