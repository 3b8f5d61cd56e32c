"""Draws with matplotlib and hands back SVG that takes its colours and its font from the page."""

from __future__ import annotations

import html
import io
import re
from collections.abc import Callable
from typing import Any, Final

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

# Placeholders that become CSS: the page decides the colours, light or dark, also after the picture is drawn.
INK: Final = "#010101"
GRID: Final = "#020202"
HAZARD: Final = "#030303"
GOAL: Final = "#040404"
VASE: Final = "#050505"
MARK: Final = "#060606"
BAD: Final = "#070707"
SOFT: Final = "#080808"
ARMS: Final = ("#0a0a01", "#0a0a02", "#0a0a03", "#0a0a04", "#0a0a05", "#0a0a06")
_CSS: Final = {
    INK: "currentColor",
    GRID: "var(--grid)",
    HAZARD: "var(--hazard)",
    GOAL: "var(--goal)",
    VASE: "var(--vase)",
    MARK: "var(--mark)",
    BAD: "var(--bad)",
    SOFT: "var(--soft)",
    **{color: f"var(--arm{index})" for index, color in enumerate(ARMS)},
}
_STYLE: Final[dict[Any, Any]] = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 10,
    "text.color": INK,
    "axes.labelcolor": SOFT,
    "axes.edgecolor": GRID,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.titlecolor": SOFT,
}
WIDTH: Final = 4.7
"""Inches: half of the page, or the whole of a phone's, so that the text can be read on both."""


def arm_color(index: int) -> str:
    """The placeholder of an arm's colour, by its place among the arms."""
    return ARMS[index % len(ARMS)]


def arm_key(index: int) -> str:
    """The CSS variable of an arm's colour."""
    return f"arm{index % len(ARMS)}"


def draw(name: str, alt: str, paint: Callable[[Axes], None], height: float = 2.9) -> str:
    """One axes, painted, as SVG for a page.

    Args:
        name: Unique on the page: the picture's ids begin with it.
        alt: What a reader who cannot see the picture is told.
        paint: Called with the axes.
        height: In inches; the width is `WIDTH`.
    """
    with mpl.rc_context({**_STYLE, "svg.hashsalt": name}):
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        paint(figure.subplots())
        return _svg(figure, name, alt)


def _svg(figure: Figure, name: str, alt: str) -> str:
    buffer = io.StringIO()
    figure.savefig(
        buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None}
    )
    text = buffer.getvalue()
    text = text[text.index("<svg") :]  # no XML prologue inside a page
    text = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", text, flags=re.DOTALL)
    # HTML knows SVG; what is left holds no address at all.
    text = re.sub(r'\s(xmlns(:\w+)?)="[^"]*"', "", text)
    # Two pictures in one page must not share ids. Theirs begin with names of arms.
    name = re.sub(r"[^\w.-]", "-", name)
    text = re.sub(r'\bid="([^"]+)"', rf'id="{name}-\1"', text)
    text = re.sub(r"url\(#([^)]+)\)", rf"url(#{name}-\1)", text)
    text = re.sub(r'xlink:href="#([^"]+)"', rf'href="#{name}-\1"', text)
    text = re.sub(r"font: ([^;\"]*?)px [^;\"]*", r"font-size: \1px", text)
    for placeholder, css in _CSS.items():
        text = text.replace(placeholder, css)
    label = html.escape(alt, quote=True)
    return re.sub(
        r'<svg [^>]*?(viewBox="[^"]*")[^>]*>',
        lambda found: f'<svg {found[1]} role="img" aria-label="{label}">',
        text,
    )
