"""What came out: a metric of the trained policies, every seed as a dot."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes

from ..evaluation.summary import Estimate, Summary, number
from ..files import Row
from .canvas import arm_color, draw
from .picture import Picture, Plotted
from .plane import CONDITIONS


def finals_picture(
    name: str, title: str, unit: str, metric: str, summary: Summary, arms: list[str]
) -> Picture:
    """A row per arm and condition: seeds as dots, the interquartile mean and its interval beside them.

    Args:
        name: Unique on the page.
        title: Of the picture.
        unit: What the axis counts.
        metric: One of `metrics.METRICS`.
        summary: The numbers.
        arms: All arms, in the order of their colours.
    """
    rows = [
        (arm, condition, summary.table[arm][condition][metric])
        for arm in arms
        for condition in CONDITIONS
        if metric in summary.table[arm][condition]
    ]
    if not rows:
        return Picture(title, "Nothing has been evaluated yet: run `safe-wrappers evaluate`.")
    best, worst = (choose(rows, key=lambda row: row[2].iqm) for choose in (max, min))
    reading = (
        f"From {number(worst[2].iqm)} ({worst[0]}, filter {CONDITIONS[worst[1]]}) to {number(best[2].iqm)}"
        f" ({best[0]}, filter {CONDITIONS[best[1]]})."
        if best[2].iqm > worst[2].iqm
        else f"{number(best[2].iqm)} everywhere."
    )
    seeds, bar = rows[0][2].seeds, rows[0][2].spread
    reading += f" {seeds} seeds; the bar is their {bar}." if bar else " One seed: no interval."

    def paint(axes: Axes) -> None:
        axes.grid(False, axis="y")
        axes.set_xlabel(unit)
        for place, (arm, condition, estimate) in enumerate(rows):
            color = arm_color(arms.index(arm))
            fill = "none" if condition == "filter_off" else color
            values = [
                row[metric] for row in summary.per_seed if (row["arm"], row["condition"]) == (arm, condition)
            ]
            if estimate.low is not None and estimate.high is not None:
                axes.hlines(place, estimate.low, estimate.high, color=color, linewidth=5, alpha=0.3)
            if len(values) > 1:
                # Dots beside each other where seeds agree.
                spread = 0.22 * np.linspace(-1, 1, len(values))
                axes.scatter(values, place + spread, s=16, facecolor=fill, edgecolor=color, linewidths=0.9)
            axes.vlines(estimate.iqm, place - 0.33, place + 0.33, color=color, linewidth=2.2)
        axes.set_yticks(range(len(rows)), [f"{arm}, {CONDITIONS[condition]}" for arm, condition, _ in rows])
        axes.tick_params(axis="y", length=0)
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.margins(x=0.08)
        if best[2].iqm == worst[2].iqm == 0:
            axes.set_xlim(-0.08, 1)

    table: list[Row] = [
        {"arm": arm, "filter": CONDITIONS[condition], "what": what, metric: value}
        for arm, condition, estimate in rows
        for what, value in _values(summary, arm, condition, metric, estimate)
    ]
    data = Plotted(name, ("arm", "filter", "what", metric), table)
    svg = draw(name, f"{title}. {reading}", paint, height=0.8 + 0.42 * len(rows))
    return Picture(title, reading, svg, data=data)


def _values(
    summary: Summary, arm: str, condition: str, metric: str, estimate: Estimate
) -> Iterator[tuple[str, float]]:
    """A row's line, the ends of its bar, and its dots."""
    yield "mean", estimate.iqm
    if estimate.low is not None and estimate.high is not None:
        yield from (("low", estimate.low), ("high", estimate.high))
    for row in summary.per_seed:
        if (row["arm"], row["condition"]) == (arm, condition):
            yield f"seed {row['seed']}", float(row[metric])
