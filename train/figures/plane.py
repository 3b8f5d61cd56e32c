"""Return against cost: what the filter buys and what it takes, every seed as a dot."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

from matplotlib.axes import Axes

from ..evaluation.summary import Estimate, Summary, number
from ..files import Row
from .canvas import arm_color, arm_key, draw
from .picture import Key, Picture, Plotted

Limits = tuple[tuple[float, float], tuple[float, float]]
"""Of returns and of costs."""
CONDITIONS: Final = {"filter_off": "off", "filter_on": "on"}


def plane_limits(summaries: Sequence[Summary]) -> Limits:
    """A frame that holds every seed's evaluation of several experiments, with some air."""
    rows = [row for summary in summaries for row in judged_rows(summary)]
    spans = []
    for metric in ("return", "cost"):
        values = [float(row[metric]) for row in rows]
        low, high = min(values), max(values)
        if low == high:
            high = low + 1.0
        air = 0.06 * (high - low)
        spans.append((low - air, high + air))
    return spans[0], spans[1]


def judged_rows(summary: Summary) -> list[dict[str, Any]]:
    """The seeds' evaluations of which somebody judged the cost."""
    return [row for row in summary.per_seed if row["condition"] in CONDITIONS and "cost" in row]


def plane_picture(
    summary: Summary,
    arms: list[str],
    name: str = "plane",
    title: str = "Return against cost",
    limits: Limits | None = None,
) -> Picture:
    """Each arm's evaluation with the filter off (ring) and on (disc), an arrow between them.

    Args:
        summary: The numbers.
        arms: All arms, in the order of their colours.
        name: Unique on the page.
        title: Of the picture.
        limits: From `plane_limits`, to share a frame with other pictures.
    """
    ends = {arm: _ends(summary, arm) for arm in arms}
    ends = {arm: of_arm for arm, of_arm in ends.items() if of_arm}
    if not ends:
        return Picture(title, "Nothing has been evaluated yet: run `safe-wrappers evaluate`.")
    reading = " ".join(filter(None, (_sentence(arm, of_arm) for arm, of_arm in ends.items())))
    (left, right), (low, high) = limits or plane_limits([summary])

    def paint(axes: Axes) -> None:
        axes.set(xlabel="return per episode (more is better)", title="cost per episode (less is better)")
        axes.set(xlim=(left, right), ylim=(low, high))
        for arm, of_arm in ends.items():
            _paint_arm(axes, summary, arm, of_arm, arm_color(arms.index(arm)))

    keys: dict[str, Key] = {}
    for arm in ends:
        keys |= {
            f"{arm}, filter {CONDITIONS[condition]}": (
                arm_key(arms.index(arm)),
                "ring" if condition == "filter_off" else "disc",
            )
            for condition in ends[arm]
        }
    rows = [row for arm, of_arm in ends.items() for row in _rows(summary, arm, of_arm)]
    data = Plotted(name, ("arm", "filter", "what", "return", "cost"), rows)
    return Picture(title, reading, draw(name, f"{title}. {reading}", paint, height=3.1), keys, data)


def _rows(summary: Summary, arm: str, ends: dict[str, tuple[Estimate, Estimate]]) -> Iterator[Row]:
    """The large marks, the ends of their bars, and the seeds' dots."""
    for condition, (x, y) in ends.items():
        of = {"arm": arm, "filter": CONDITIONS[condition]}
        yield of | {"what": "mean", "return": x.iqm, "cost": y.iqm}
        for what in ("low", "high"):
            bar = {"return": getattr(x, what), "cost": getattr(y, what)}
            if None not in bar.values():
                yield of | {"what": what} | bar
        for row in judged_rows(summary):
            if (row["arm"], row["condition"]) == (arm, condition):
                yield of | {"what": f"seed {row['seed']}", "return": row["return"], "cost": row["cost"]}


def _ends(summary: Summary, arm: str) -> dict[str, tuple[Estimate, Estimate]]:
    found = {}
    for condition in CONDITIONS:
        cell = summary.table.get(arm, {}).get(condition, {})
        if "return" in cell and "cost" in cell:
            found[condition] = (cell["return"], cell["cost"])
    return found


def _paint_arm(
    axes: Axes, summary: Summary, arm: str, ends: dict[str, tuple[Estimate, Estimate]], color: str
) -> None:
    if len(ends) == 2:
        off, on = ((x.iqm, y.iqm) for x, y in ends.values())
        arrow = {
            "arrowstyle": "-|>",
            "color": color,
            "alpha": 0.6,
            "linewidth": 1.2,
            "shrinkA": 7,
            "shrinkB": 7,
        }
        axes.annotate("", xy=on, xytext=off, arrowprops=arrow)
    for condition, (x, y) in ends.items():
        fill = "none" if condition == "filter_off" else color
        rows = [row for row in judged_rows(summary) if (row["arm"], row["condition"]) == (arm, condition)]
        if len(rows) > 1:
            seeds = [row["return"] for row in rows], [row["cost"] for row in rows]
            axes.scatter(
                *seeds, s=14, facecolor=fill, edgecolor=color, alpha=0.5, linewidths=0.8, clip_on=False
            )
        for estimate, other, line in ((x, y, axes.hlines), (y, x, axes.vlines)):
            if estimate.low is not None and estimate.high is not None:
                line(other.iqm, estimate.low, estimate.high, color=color, linewidth=1.0, alpha=0.7)
        axes.scatter(
            x.iqm, y.iqm, s=62, facecolor=fill, edgecolor=color, linewidths=1.8, zorder=3, clip_on=False
        )


def _sentence(arm: str, ends: dict[str, tuple[Estimate, Estimate]]) -> str:
    if len(ends) < 2:
        ((x, y),) = ends.values()
        return f"“{arm}”: return {number(x.iqm)}, cost {number(y.iqm)}."
    (x0, y0), (x1, y1) = ends.values()
    return (
        f"“{arm}”: putting the filter on took the cost from {number(y0.iqm)} to {number(y1.iqm)} and the"
        f" return from {number(x0.iqm)} to {number(x1.iqm)}."
    )
