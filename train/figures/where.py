"""Where in state space something happened: how often, cell by cell of the two most telling coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from ..evaluation.step_log import StepLog
from ..files import Row
from .canvas import BAD, INK, MARK, draw
from .picture import Picture, Plotted
from .telling import telling_pair

_CELLS: Final = 32


@dataclass(frozen=True)
class View:
    """Two coordinates to look at, and the frame, so that several pictures can be compared."""

    x: int
    y: int
    extent: tuple[float, float, float, float]


def choose_view(acting: StepLog, bare: StepLog | None) -> View | None:
    """The plane in which the steps that the filter changed lie most apart from the others, and a frame there.

    The frame holds nearly all steps that were changed (and, without the filter, in violation), and around
    them as much again, as far as any step went.

    Args:
        acting: Steps with the filter on.
        bare: Steps without it, of the same task, to be looked at in the same frame.

    Returns:
        None when there is nothing to place: fewer than two coordinates, or all steps alike.
    """
    if acting.coordinates.shape[1] < 2 or acting.intervened.all() or not acting.intervened.any():
        return None
    at = telling_pair(acting.coordinates, acting.intervened)
    logs = [(acting, acting.intervened)] + ([(bare, bare.violated)] if bare is not None else [])
    ends = [
        _frame(
            np.concatenate([log.coordinates[:, column] for log, _ in logs]).astype(float),
            np.concatenate([flags for _, flags in logs]),
        )
        for column in at
    ]
    return View(*at, (*ends[0], *ends[1]))


def _frame(values: NDArray[np.float64], flags: NDArray[np.bool_]) -> tuple[float, float]:
    low, high = np.nanquantile(values[flags], (0.005, 0.995))
    air = 0.5 * (high - low) or 1.0
    first, last = max(low - air, float(np.nanmin(values))), min(high + air, float(np.nanmax(values)))
    return (first, last) if last > first else (first - 0.5, last + 0.5)


def where_picture(name: str, title: str, log: StepLog, view: View, of: str) -> Picture:
    """The share of steps in each cell that the filter changed, or that were in violation.

    Args:
        name: Unique on the page.
        title: Of the picture.
        log: The steps.
        view: From `choose_view`.
        of: "intervened" or "violated".
    """
    flags: NDArray[np.bool_] = getattr(log, of)
    places = log.coordinates[:, (view.x, view.y)]
    names = [str(log.coordinate_names[at]) for at in (view.x, view.y)]
    verb, color = ("changed", MARK) if of == "intervened" else ("in violation", BAD)
    total = f"{len(flags):,} steps"
    total_share = flags.mean()
    low, high = np.array(view.extent).reshape(2, 2).T
    inside = ((places >= low) & (places <= high)).all(axis=1)
    places, flags = places[inside], flags[inside]
    if flags.any():
        cells = _Cells(places, flags, view)
        reading = (
            f"{100 * total_share:.2g} % of {total} were {verb}, in {100 * cells.acted:.0f} % of the cells that were"
            f" visited; most often near ({cells.hottest[0]:.2g}, {cells.hottest[1]:.2g})."
        )
    else:
        reading = f"None of {total} was {verb}."
    hexagons: list[Row] = []
    paint = _painter(places, flags, view, names, color, hexagons)
    svg = draw(name, f"{title}. {names[1]} over {names[0]}. {reading}", paint, height=3.1)
    return Picture(
        title,
        reading,
        svg,
        {
            "visited": ("grid", "fill"),
            f"{verb}; the stronger, the more often": ("mark" if color == MARK else "bad", "fill"),
        },
        Plotted(name, (*names, "steps", "share"), hexagons),
    )


class _Cells:
    """What the cells say, in numbers."""

    def __init__(self, places: NDArray[np.floating], flags: NDArray[np.bool_], view: View) -> None:
        x0, x1, y0, y1 = view.extent
        bins: dict[str, Any] = {"bins": _CELLS, "range": ((x0, x1), (y0, y1))}
        visited, *edges = np.histogram2d(*places.T, **bins)
        flagged, *_ = np.histogram2d(*places[flags].T, **bins)
        self.acted = float((flagged > 0).sum() / (visited > 0).sum())
        best = np.unravel_index(np.argmax(flagged), flagged.shape)
        self.hottest = [float(edge[at] + edge[at + 1]) / 2 for edge, at in zip(edges, best, strict=True)]


def _painter(
    places: NDArray[np.floating],
    flags: NDArray[np.bool_],
    view: View,
    names: list[str],
    color: str,
    hexagons: list[Row],
) -> Any:
    """Paints the cells, and adds each with its centre, steps and share to `hexagons`."""

    def paint(axes: Axes) -> None:
        axes.set(xlabel=names[0], title=names[1])
        if all(name.endswith("(m)") for name in names):
            axes.set_aspect("equal")  # a round obstacle is to look round
        x0, x1, y0, y1 = view.extent
        axes.set_xlim(x0 - 0.02 * (x1 - x0), x1 + 0.02 * (x1 - x0))
        axes.set_ylim(y0 - 0.02 * (y1 - y0), y1 + 0.02 * (y1 - y0))
        found = []
        for values, paper, least in ((np.ones(len(flags)), INK, 0.08), (flags, color, 0.0)):
            cells = axes.hexbin(
                places[:, 0],
                places[:, 1],
                C=values,
                reduce_C_function=np.sum if paper == INK else np.mean,
                gridsize=(_CELLS, int(_CELLS * 0.55)),
                extent=view.extent,
                linewidths=0,
            )
            strength = np.asarray(cells.get_array(), dtype=float)
            found.append((np.asarray(cells.get_offsets()), strength))
            strength = np.full(len(strength), least) if paper == INK else np.sqrt(strength)
            cells.set_array(None)
            shown = strength > 0
            cells.set_offsets(np.asarray(cells.get_offsets())[shown])
            cells.set_facecolor([(*to_rgb(paper), alpha) for alpha in strength[shown]])
            cells.set_edgecolor("none")
        (centres, steps), (_, shares) = found
        for (x, y), count, share in zip(centres, steps, shares, strict=True):
            place = {names[0]: float(x), names[1]: float(y)}
            hexagons.append(place | {"steps": int(count), "share": float(share)})

    return paint
