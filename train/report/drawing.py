"""Draws with matplotlib, and hands back an image inside the page."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

COLORS: Final = ("#d1601f", "#1a6fb5", "#3d8b5f", "#8f5bb3", "#8a7a1e", "#b0447a")
"""Of the arms, in their order."""
MARK: Final = "#e0a100"
"""What the filter changed."""
BAD: Final = "#d0202e"
"""Violations."""
SOFT: Final = "#5c6672"
_STYLE: Final[dict[Any, Any]] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "safe-wrappers",
    "text.parse_math": False,
    "font.size": 10,
    "axes.labelcolor": SOFT,
    "axes.titlecolor": SOFT,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.edgecolor": "#d9dce0",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#e3e5e8",
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "legend.frameon": False,
    "legend.fontsize": 9,
}
WIDTH: Final = 4.7
"""Inches: half of the page, or the whole of a phone's, so that the text can be read on both."""


class Picture(NamedTuple):
    """A picture, or, where there is nothing to draw, only the sentence that says so."""

    title: str
    reading: str
    """A sentence that reads it for the case at hand; also what a reader is told who cannot see it."""
    image: str = ""
    """A data URI."""


def color_of(arm: str, arms: Sequence[str]) -> str:
    """An arm's colour."""
    return COLORS[arms.index(arm) % len(COLORS)]


def draw(paint: Callable[[Axes], None], height: float = 2.9) -> str:
    """One axes, painted, with its legend above it, as an SVG image for a page.

    Args:
        paint: Called with the axes.
        height: In inches; the width is `WIDTH`.
    """
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        axes = figure.subplots()
        paint(axes)
        marks, labels = axes.get_legend_handles_labels()
        if labels:
            figure.legend(
                marks, labels, loc="outside upper left", ncols=min(len(labels), 3) if len(labels) != 4 else 2
            )
        data = io.BytesIO()
        figure.savefig(data, format="svg", metadata={"Date": None})
    return data_uri("image/svg+xml", data.getvalue())


def data_uri(kind: str, data: bytes) -> str:
    """A file inside the page."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
