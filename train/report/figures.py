"""How it was learned, what was refused, and where the filter stepped in: pictures, each with a sentence on it.

Matplotlib draws them; they are images inside the page.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import Any, Final, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator
from numpy.typing import NDArray

from ..evaluation.step_log import StepLog
from ..evaluation.summary import Curve, number

CONDITIONS: Final = {"filter_off": "off", "filter_on": "on"}
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
_CELLS: Final = 32
_BINS: Final = 8


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
    """One axes, painted, with its legend above it, as an SVG image for a page."""
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


def curve_picture(title: str, unit: str, curves: Mapping[str, Curve | None], arms: Sequence[str]) -> Picture:
    """A metric over training: the mean over seeds as a line, its interval as a band, the seeds as faint lines."""
    there = {arm: curve for arm, curve in curves.items() if curve is not None}
    if not there:
        return Picture(title, "No finished training episode of every seed yet.")

    def paint(axes: Axes) -> None:
        axes.set(xlabel="training steps", title=unit)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.xaxis.set_major_locator(MaxNLocator(6))
        for arm, curve in there.items():
            color = color_of(arm, arms)
            if len(curve.seeds) > 1:
                axes.plot(curve.steps, curve.seeds.T, color=color, linewidth=0.8, alpha=0.35)
            if curve.low is not None and curve.high is not None:
                axes.fill_between(curve.steps, curve.low, curve.high, color=color, alpha=0.14, linewidth=0)
            axes.plot(curve.steps, curve.iqm, color=color, linewidth=2, label=arm)

    moves = []
    for arm, curve in there.items():
        tenth = max(1, len(curve.iqm) // 10)
        first, last = (number(float(part.mean())) for part in (curve.iqm[:tenth], curve.iqm[-tenth:]))
        moves.append(f"“{arm}” {first} to {last}")
    reading = f"From the first to the last tenth of training: {'; '.join(moves)}."
    return Picture(title, reading, draw(paint))


def refusals(logs: Mapping[str, StepLog]) -> Picture:
    """Which constraint refused how many of the policies' (boxed) actions, and how large corrections were."""
    said = []
    for arm, log in logs.items():
        shares = sorted(zip(log.refused.mean(axis=0), log.constraint_names, strict=True), reverse=True)
        acted = ", ".join(f"{name} {100 * share:.2g} %" for share, name in shares if share > 0)
        if shares:
            said.append(f"“{arm}”: of {len(log):,} actions refused by {acted or 'no constraint'}.")
        never = ", ".join(name for share, name in shares if share == 0)
        if never:
            said.append(
                f"Never acted: {never}: a limit may be out of reach, or in another unit; angles are in rad."
            )
        values = log.correction[log.intervened]
        if values.size:
            half, most = number(float(np.median(values))), number(float(values.max()))
            said.append(
                f"Half of its {values.size:,} corrections were below {half}, the largest {most} (L2)."
            )
    return Picture("Which constraint refused, and how large corrections were", " ".join(said))


def telling_pair(coordinates: NDArray[np.floating], flags: NDArray[np.bool_]) -> tuple[int, int]:
    """Picks the two coordinates in whose plane flagged steps lie most apart from the others.

    Apart is measured by total variation between the two histograms over 8 by 8 quantile bins: 0 where
    flagged steps are spread as the others, 1 where the two never meet.

    Args:
        coordinates: Shape (T, D), D >= 2, finite.
        flags: Shape (T,), with at least one True and one False.

    Returns:
        Their columns, in order.
    """
    inner = np.linspace(0, 1, _BINS + 1)[1:-1]
    cells = [np.searchsorted(np.unique(np.quantile(column, inner)), column) for column in coordinates.T]

    def apart(pair: tuple[int, int]) -> float:
        cell = cells[pair[0]] * _BINS + cells[pair[1]]
        here, there = (np.bincount(cell[part], minlength=_BINS**2) / part.sum() for part in (flags, ~flags))
        return float(np.abs(here - there).sum())

    return max(combinations(range(len(cells)), 2), key=apart)


def place_pictures(arm: str, log: StepLog, bare_arm: str, bare: StepLog | None) -> list[Picture]:
    """The shares of steps that the filter changed, cell by cell of the two most telling coordinates."""
    title = f"Where the filter stepped in: {arm}"
    if log.coordinates.shape[1] < 2 or not np.isfinite(log.coordinates).all():
        return [Picture(title, "This task has fewer than two coordinates that could be read.")]
    if log.intervened.all() or not log.intervened.any():
        what = "Everywhere: all" if log.intervened.any() else "Nowhere: none"
        return [Picture(title, f"{what} of {len(log):,} steps were changed.")]
    pair = telling_pair(log.coordinates, log.intervened)
    shown = [(title, log, log.intervened, "changed", MARK)]
    if bare is not None and bare.violated.any() and list(bare.coordinate_names) == list(log.coordinate_names):
        violations = f"Where violations were: {bare_arm}, filter off"
        shown.insert(0, (violations, bare, bare.violated, "in violation", BAD))
    flagged = np.concatenate([steps.coordinates[flags] for _, steps, flags, _, _ in shown])[:, pair]
    low, high = np.quantile(flagged, (0.005, 0.995), axis=0)
    air = np.where(high > low, 0.5 * (high - low), 0.5)
    return [_place(*each, pair, low - air, high + air) for each in shown]


def _place(
    title: str,
    log: StepLog,
    flags: NDArray[np.bool_],
    verb: str,
    color: str,
    pair: tuple[int, int],
    low: NDArray[np.floating],
    high: NDArray[np.floating],
) -> Picture:
    places = log.coordinates[:, pair]
    inside = ((places >= low) & (places <= high)).all(axis=1)
    names = [str(log.coordinate_names[at]) for at in pair]

    def paint(axes: Axes) -> None:
        axes.set(xlabel=names[0], title=names[1])
        if all(name.endswith("(m)") for name in names):
            axes.set_aspect("equal")  # a round obstacle is to look round
        shades = LinearSegmentedColormap.from_list("shares", ["#e8e9ea", color])
        cells = axes.hexbin(
            places[inside, 0],
            places[inside, 1],
            C=flags[inside],
            gridsize=(_CELLS, int(_CELLS * 0.55)),
            extent=(low[0], high[0], low[1], high[1]),
            cmap=shades,
            vmin=0,
            vmax=1,
        )
        bar = axes.figure.colorbar(cells, ax=axes, shrink=0.8)
        bar.set_label(f"share of steps {verb}")

    middle = np.median(places[flags], axis=0)
    about = f"in the middle of them ({middle[0]:.2g}, {middle[1]:.2g})"
    reading = f"{100 * flags.mean():.2g} % of {len(flags):,} steps were {verb}; {about}."
    return Picture(title, reading, draw(paint, height=3.2))
