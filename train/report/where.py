"""Where it happened: an episode from above, and the places in state space at which the filter stepped in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any, Final, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.patches import Circle
from numpy.typing import NDArray

from ..evaluation.step_log import StepLog
from .drawing import BAD, MARK, Picture, draw

_CELLS: Final = 32
_BINS: Final = 8
_MOST_ROWS: Final = 20_000
_HAZARD, _GOAL, _VASE = "#6f7fd6", "#2c8f4e", "#2aa5ad"


class Scene(NamedTuple):
    """An episode of a log, seen from above.

    Attributes:
        title: Of its picture.
        color: Of its path.
        log: Steps, whose first two coordinates are x and y in m.
        steps: Those of the episode, shape (T,).
        places: As `StepRecorder` has them.
    """

    title: str
    color: str
    log: StepLog
    steps: NDArray[np.bool_]
    places: Mapping[str, Any]

    @property
    def path(self) -> NDArray[np.floating]:
        """Where each step began, shape (steps, 2), m."""
        return self.log.coordinates[self.steps][:, :2]


def scene_pictures(scenes: Sequence[Scene]) -> list[Picture]:
    """Paths among hazards, goals and vases, where the filter acted, and violations; all in one frame."""
    points = [scene.path for scene in scenes]
    points += [
        np.array(scene.places[what])[:, :2]
        for scene in scenes
        for what in ("hazard", "goal")
        if scene.places[what]
    ]
    return [_scene_picture(scene, np.concatenate(points)) for scene in scenes]


def _scene_picture(scene: Scene, inside: NDArray[np.floating]) -> Picture:
    path, places = scene.path, scene.places
    changed, violated = scene.log.intervened[scene.steps], scene.log.violated[scene.steps]

    def paint(axes: Axes) -> None:
        (left, low), (right, high) = inside.min(axis=0) - 0.4, inside.max(axis=0) + 0.4
        axes.set(xlabel="x in m", title="y in m", aspect="equal", xlim=(left, right), ylim=(low, high))
        for what, radius, hue in (
            ("hazard", places["hazard_radius"], _HAZARD),
            ("goal", places["goal_radius"], _GOAL),
            ("vase", 0.1, _VASE),
        ):
            size = float(np.max(radius, initial=0.0))
            for at, place in enumerate(places[what]):
                label = what if at == 0 else None
                axes.add_patch(Circle(place[:2], size, facecolor=hue, alpha=0.4, label=label))
        for at, place in enumerate(places["goal"], start=1):
            axes.text(place[0], place[1], str(at), color=_GOAL, ha="center", va="center", weight="bold")
        axes.plot(*path.T, color=scene.color, linewidth=1.3, label="path")
        axes.plot(*path[0], "o", markerfacecolor="none", color="black", linestyle="none", label="start")
        for flags, what, mark, size in (
            (changed, "changed by the filter", MARK, 8),
            (violated, "in violation", BAD, 14),
        ):
            if flags.any():
                axes.scatter(path[flags, 0], path[flags, 1], s=size, color=mark, zorder=3, label=what)

    reading = (
        f"{violated.sum():,} of {len(path):,} steps in violation, {changed.sum():,} changed by the filter."
    )
    return Picture(scene.title, reading, draw(paint, height=4.1))


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
    every = -(-len(flags) // _MOST_ROWS)
    if flags[::every].any() and not flags[::every].all():
        coordinates, flags = coordinates[::every], flags[::every]
    inner = np.linspace(0, 1, _BINS + 1)[1:-1]
    cells = [np.searchsorted(np.unique(np.quantile(column, inner)), column) for column in coordinates.T]

    def apart(pair: tuple[int, int]) -> float:
        cell = cells[pair[0]] * _BINS + cells[pair[1]]
        here, there = (np.bincount(cell[part], minlength=_BINS**2) / part.sum() for part in (flags, ~flags))
        return float(np.abs(here - there).sum())

    return max(combinations(range(len(cells)), 2), key=apart)


def place_pictures(arm: str, log: StepLog, bare_arm: str, bare: StepLog | None) -> list[Picture]:
    """The shares of steps that the filter changed, cell by cell of the two most telling coordinates.

    Args:
        arm: The filtered arm.
        log: Its evaluation steps with the filter on.
        bare_arm: The arm without the filter.
        bare: Its steps with the filter off; where violations were is shown in the same frame.
    """
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
