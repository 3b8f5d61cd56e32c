"""The executed action: projected onto the row and the box at once, against clamped afterwards."""

import itertools
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle

import safe_wrappers as sw
from _style import FORBIDDEN, GRID, INK, OFF, ON, OTHER, SAFE, panels
from safe_wrappers.errors import Array

LOW, HIGH = np.array([-1.0, -1.0]), np.array([1.0, 1.0])
_POLICY = {"marker": "o", "color": OFF, "ms": 7}
_EXECUTED = {"marker": "o", "color": ON, "ms": 7}


def draw() -> Figure:
    """Left: one row. Right: a row and the box, where clamping the row's answer breaks the row."""
    figure, (left, right) = panels(2, height=3.0, width_ratios=[2.6, 3.6])
    normal, offset = np.array([0.35, 1.0]), 0.35
    nominal = np.array([0.2, 0.85])
    world(left, normal, offset)
    executed = arrow(left, nominal, normal, offset)
    left.text(0.1, 0.87, "policy's", color=OFF, ha="right", va="center")
    left.text(*(executed + np.array([-0.05, -0.15])), "executed", color=ON, ha="right", va="center")
    left.plot(-0.55, -0.45, **_EXECUTED)
    left.text(-0.44, -0.45, "admitted: passes\nbit for bit", color=ON, va="center")

    normal, offset = np.array([-1.0, 0.55]), -0.95
    nominal = np.array([0.5, 0.9])
    world(right, normal, offset)
    row_only = nominal - (normal @ nominal - offset) / (normal @ normal) * normal
    clamped = np.clip(row_only, LOW, HIGH)
    assert normal @ clamped > offset + 0.1  # clamping has broken the row
    astray(right, nominal, row_only, clamped)
    right.text(1.42, 0.5, "row first, then\nclamped: breaks\nthe row", color=FORBIDDEN, va="center")
    right.text(1.2, -0.1, "row and bounds\ntogether", color=ON, va="center")
    arrow(right, nominal, normal, offset)
    left.set(xlim=(-1.25, 1.35), ylim=(-1.25, 1.25))
    right.set(xlim=(-1.25, 2.35), ylim=(-1.25, 1.25))
    return figure


def world(ax: Axes, normal: Array, offset: float) -> None:
    """The box, and the admitted part of it: the box's polygon cut by the half-space."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=float)
    kept = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        excess_a, excess_b = normal @ a - offset, normal @ b - offset
        if excess_a <= 0:
            kept.append(a)
        if excess_a * excess_b < 0:
            kept.append(a + (b - a) * excess_a / (excess_a - excess_b))
    admitted(ax, kept, normal[None], np.array([offset]))


def admitted(ax: Axes, corners: Any, normals: Array, offsets: Array) -> None:
    """A polygon, the box, and the edges of half-spaces."""
    ax.add_patch(Polygon(corners, color=SAFE, alpha=0.2, lw=0))
    ax.add_patch(Rectangle((-1, -1), 2, 2, fill=False, ec=GRID, ls="--"))
    for normal, offset in zip(normals, offsets, strict=True):
        along = np.array([-normal[1], normal[0]]) / np.linalg.norm(normal)
        foot = offset * normal / (normal @ normal)
        ax.plot(*np.array([foot - 3 * along, foot + 3 * along]).T, color=FORBIDDEN, lw=1.2)
    ax.set(aspect="equal", xlabel="$u_1$", xticks=[-1, 0, 1], yticks=[-1, 0, 1])
    ax.set_ylabel("$u_2$", rotation=0)


def astray(ax: Axes, *points: Array) -> None:
    """A way that ends where it should not."""
    for start, end in itertools.pairwise(points):
        ax.annotate("", end, start, arrowprops={"arrowstyle": "->", "color": OTHER, "ls": ":"})
    ax.plot(*points[-1], "X", color=FORBIDDEN, ms=9)


def arrow(ax: Axes, start: Array, normal: Array, offset: Any) -> Array:
    """From the policy's action to the library's answer."""
    end = sw.project(start, normal, offset, LOW, HIGH).control
    ax.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": INK, "shrinkA": 4, "shrinkB": 4})
    ax.plot(*start, **_POLICY)
    ax.plot(*end, **_EXECUTED)
    return end
