"""How pictures look: colours by meaning, as CSS variables that the page sets for light and for dark."""

import io
import re
import warnings
from collections.abc import Callable
from typing import Any, Final

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from safe_wrappers import UnsafeStateWarning

INK: Final = "#010101"
"""Text, axes and what needs no colour."""
GRID: Final = "#020202"
"""What may be faint."""
OFF: Final = "#030303"
"""The policy alone: unfiltered, proposed."""
ON: Final = "#040404"
"""Filtered, executed."""
FORBIDDEN: Final = "#050505"
"""Limits, obstacles, violations."""
SAFE: Final = "#060606"
"""What is admitted."""
OTHER: Final = "#070707"
"""A third thing to compare with."""

# The page's variable, and a colour that is legible on white and on black where there is no page around it.
_CSS: Final = {
    INK: "var(--drawn-ink, #7a828c)",
    GRID: "var(--drawn-grid, #8a929c)",
    OFF: "var(--drawn-off, #d9722e)",
    ON: "var(--drawn-on, #2f86c9)",
    FORBIDDEN: "var(--drawn-forbidden, #d2404c)",
    SAFE: "var(--drawn-safe, #3f9a68)",
    OTHER: "var(--drawn-other, #9a6fc0)",
}
_RC: Final[dict[Any, Any]] = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "mathtext.default": "regular",
    "font.size": 9.5,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": GRID,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "legend.frameon": False,
    "legend.fontsize": 9,
    "xtick.color": INK,
    "ytick.color": INK,
    "grid.color": GRID,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "lines.linewidth": 1.7,
    "lines.solid_capstyle": "round",
    "figure.constrained_layout.use": True,
}


def panels(
    columns: int = 1, width: float = 7.2, height: float = 3.0, rows: int = 1, **more: Any
) -> tuple[Figure, Any]:
    """A figure and its axes, without pyplot's global state."""
    figure = Figure(figsize=(width, height))
    return figure, figure.subplots(rows, columns, **more)


def disc(ax: Axes, center: Any, radius: float) -> None:
    """A hazard."""
    ax.add_patch(Circle(center, radius, color=FORBIDDEN, alpha=0.35, lw=0))


def bare(ax: Axes) -> None:
    """A map: equal scales, no ticks."""
    ax.set_aspect("equal")
    ax.set_xticks([])
    ax.set_yticks([])
    for side in ax.spines.values():
        side.set_visible(False)


def as_svg(draw: Callable[[], Figure], name: str) -> str:
    """SVG text that depends on nothing but the code: no dates, no random ids, colours as variables."""
    text = io.StringIO()
    with mpl.rc_context({**_RC, "svg.hashsalt": name}), warnings.catch_warnings():
        warnings.simplefilter("ignore", UnsafeStateWarning)  # pictures show unsafe states on purpose
        draw().savefig(text, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    body = text.getvalue()
    body = body[body.index("<svg ") :]  # no XML prologue: it stands inside a page
    body = re.sub(r"<metadata>.*?</metadata>", "", body, flags=re.DOTALL)
    body = re.sub(r"(font(-family)?: [^;\"]*?)'?DejaVu Sans'?[^;\"]*", r"\1system-ui, sans-serif", body)
    for placeholder, variable in _CSS.items():
        body = body.replace(placeholder, variable)
    return body
