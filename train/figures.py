"""The report's pictures, as SVG that takes its colours and its font from the page."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from typing import Any, Final

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from matplotlib.ticker import EngFormatter, MaxNLocator

from .curves import Curve
from .scene import Scene

# Placeholders that become CSS: the page decides the colours, light or dark, also after the picture is drawn.
_INK: Final = "#010101"
_GRID: Final = "#020202"
_HAZARD: Final = "#030303"
_GOAL: Final = "#040404"
_VASE: Final = "#050505"
_MARK: Final = "#060606"
_BAD: Final = "#070707"
_ARMS: Final = ("#0a0a01", "#0a0a02", "#0a0a03", "#0a0a04", "#0a0a05", "#0a0a06")
_CSS: Final = {
    _INK: "currentColor",
    _GRID: "var(--grid)",
    _HAZARD: "var(--hazard)",
    _GOAL: "var(--goal)",
    _VASE: "var(--vase)",
    _MARK: "var(--mark)",
    _BAD: "var(--bad)",
    **{color: f"var(--arm{index})" for index, color in enumerate(_ARMS)},
}
_STYLE: Final[dict[Any, Any]] = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 10,
    "text.color": _INK,
    "axes.labelcolor": _INK,
    "axes.edgecolor": _GRID,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "xtick.color": _INK,
    "ytick.color": _INK,
    "grid.color": _GRID,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
}


def curves_svg(panels: Mapping[str, Mapping[str, Curve | None]], arms: Sequence[str]) -> str:
    """A panel per metric, an arm per line, the interval over seeds as a band.

    Args:
        panels: title -> arm -> curve.
        arms: All arms, in the order of their colours.
    """
    with mpl.rc_context({**_STYLE, "svg.hashsalt": "curves"}):
        rows = (len(panels) + 1) // 2
        figure = Figure(figsize=(10, 2.9 * rows), layout="constrained")
        grid = figure.subplots(rows, 2, squeeze=False)
        for axes, (title, curves) in zip(grid.flat, panels.items(), strict=False):
            axes.set_title(title)
            axes.grid(True, linewidth=0.6)
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
            axes.xaxis.set_major_locator(MaxNLocator(6))
            axes.set_xlabel("training steps")
            for arm, curve in curves.items():
                if curve is not None:
                    _line(axes, curve, _ARMS[arms.index(arm) % len(_ARMS)])
        for axes in grid.flat[len(panels) :]:
            axes.set_visible(False)
        return _svg(figure, "curves", "Learning curves")


def scenes_svg(scenes: Sequence[tuple[str, int, Scene]]) -> str:
    """Episodes from above, side by side, in the same frame.

    Args:
        scenes: (title, index of the arm's colour, scene) from left to right.
    """
    with mpl.rc_context({**_STYLE, "svg.hashsalt": "scenes"}):
        figure = Figure(figsize=(10, 5.1), layout="constrained")
        grid = figure.subplots(1, len(scenes), sharex=True, sharey=True, squeeze=False)
        for axes, (title, color, scene) in zip(grid.flat, scenes, strict=True):
            axes.set_title(title)
            _draw(axes, scene, _ARMS[color % len(_ARMS)])
        return _svg(figure, "scenes", "Trajectories from above")


def _line(axes: Axes, curve: Curve, color: str) -> None:
    axes.plot(curve.steps, curve.iqm, color=color, linewidth=2, solid_capstyle="round")
    if curve.low is not None and curve.high is not None:
        axes.fill_between(curve.steps, curve.low, curve.high, color=color, alpha=0.18, linewidth=0)


def _draw(axes: Axes, scene: Scene, color: str) -> None:
    axes.set_aspect("equal")
    axes.set_xlabel("x in m")
    axes.set_ylabel("y in m")
    axes.grid(True, linewidth=0.4)
    for x, y in scene.hazards:
        axes.add_patch(Circle((x, y), scene.hazard_radius, facecolor=_HAZARD, alpha=0.35, linewidth=0))
    for x, y in scene.vases:
        axes.add_patch(Rectangle((x - 0.08, y - 0.08), 0.16, 0.16, facecolor=_VASE, alpha=0.5))
    for number, (x, y) in enumerate(scene.goals, start=1):
        axes.add_patch(Circle((x, y), scene.goal_radius, facecolor=_GOAL, alpha=0.1, edgecolor=_GOAL))
        axes.text(x, y, str(number), color=_GOAL, ha="center", va="center", weight="bold")
    path = scene.agent
    axes.plot(path[:, 0], path[:, 1], color=color, linewidth=1.4, solid_joinstyle="round")
    for places, mark, size in ((scene.intervened, _MARK, 9), (scene.violated, _BAD, 16)):
        x, y = path[:-1][places].T
        axes.scatter(x, y, s=size, color=mark, zorder=3, linewidths=0)
    axes.plot(*path[0], marker="o", markersize=8, markerfacecolor="none", markeredgecolor=_INK, zorder=4)
    axes.autoscale_view()


def _svg(figure: Figure, name: str, title: str) -> str:
    buffer = io.StringIO()
    figure.savefig(
        buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None}
    )
    text = buffer.getvalue()
    text = text[text.index("<svg") :]  # no XML prologue inside a page
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(
        r'\s(xmlns(:\w+)?)="[^"]*"', "", text
    )  # HTML knows SVG; what is left holds no address at all
    # Two pictures in one page must not share ids.
    text = re.sub(r'\bid="([^"]+)"', rf'id="{name}-\1"', text)
    text = re.sub(r"url\(#([^)]+)\)", rf"url(#{name}-\1)", text)
    text = re.sub(r'xlink:href="#([^"]+)"', rf'href="#{name}-\1"', text)
    text = re.sub(r"font: ([^;\"]*?)px [^;\"]*", r"font-size: \1px", text)
    for placeholder, css in _CSS.items():
        text = text.replace(placeholder, css)
    return re.sub(r'<svg [^>]*?(viewBox="[^"]*")[^>]*>', rf'<svg \1 role="img" aria-label="{title}">', text)


def legend(items: Mapping[str, Any]) -> str:
    """A line of coloured marks with their names: name -> CSS colour variable."""
    return "".join(
        f'<span class="key"><i style="background: var(--{color})"></i>{name}</span>'
        for name, color in items.items()
    )
