"""What came out and how it was learned: returns, costs and corrections, each with a sentence that reads it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter, MaxNLocator

from ..evaluation.step_log import StepLog
from ..evaluation.summary import Curve, Estimate, Summary, number
from .drawing import Picture, color_of, draw

CONDITIONS: Final = {"filter_off": "off", "filter_on": "on"}
NOTHING_EVALUATED: Final = "Nothing has been evaluated yet: run `safe-wrappers evaluate`."
_EPISODE_BINS: Final = 20


def _rows(summary: Summary, arm: str, condition: str) -> list[dict[str, Any]]:
    """The seeds' own numbers."""
    return [row for row in summary.per_seed if (row["arm"], row["condition"]) == (arm, condition)]


def _bar(line: Any, other: float, estimate: Estimate, color: str, width: float, alpha: float) -> None:
    if estimate.low is not None and estimate.high is not None:
        line(other, estimate.low, estimate.high, color=color, linewidth=width, alpha=alpha)


def plane_picture(summary: Summary, arms: Sequence[str]) -> Picture:
    """Return against cost: each arm's evaluation with the filter off (ring) and on (disc), every seed as a dot."""
    title = "Return against cost"
    ends = {
        arm: {
            condition: (cell["return"], cell["cost"])
            for condition in CONDITIONS
            if {"return", "cost"} <= (cell := summary.table[arm][condition]).keys()
        }
        for arm in arms
    }
    if not any(ends.values()):
        return Picture(title, NOTHING_EVALUATED)

    def paint(axes: Axes) -> None:
        axes.set(xlabel="return per episode (more is better)", title="cost per episode (less is better)")
        for arm, of_arm in ends.items():
            color = color_of(arm, arms)
            for condition, (x, y) in of_arm.items():
                fill = "none" if condition == "filter_off" else color
                seeds = np.array([(row["return"], row["cost"]) for row in _rows(summary, arm, condition)])
                if len(seeds) > 1:
                    axes.scatter(seeds[:, 0], seeds[:, 1], s=14, facecolor=fill, edgecolor=color, alpha=0.5)
                _bar(axes.hlines, y.iqm, x, color, 1.0, 0.7)
                _bar(axes.vlines, x.iqm, y, color, 1.0, 0.7)
                label = f"{arm}, filter {CONDITIONS[condition]}"
                axes.scatter(x.iqm, y.iqm, s=62, facecolor=fill, edgecolor=color, label=label, zorder=3)
            if len(of_arm) == 2:
                tail, head = ((x.iqm, y.iqm) for x, y in of_arm.values())
                arrow = {"arrowstyle": "-|>", "color": color, "alpha": 0.6, "shrinkA": 7, "shrinkB": 7}
                axes.annotate("", xy=head, xytext=tail, arrowprops=arrow)

    said = []
    for arm, of_arm in ends.items():
        if len(of_arm) == 2:
            (x0, y0), (x1, y1) = of_arm.values()
            said.append(
                f"“{arm}”: putting the filter on took the cost from {number(y0.iqm)} to {number(y1.iqm)} and the"
                f" return from {number(x0.iqm)} to {number(x1.iqm)}."
            )
        said += [f"“{arm}”: return {number(x.iqm)}, cost {number(y.iqm)}." for x, y in of_arm.values()][
            : len(of_arm) % 2
        ]
    return Picture(title, " ".join(said), draw(paint, height=3.4))


def curve_picture(title: str, unit: str, curves: Mapping[str, Curve | None], arms: Sequence[str]) -> Picture:
    """A metric over training: the mean over seeds as a line, its interval as a band, the seeds as faint lines.

    Args:
        title: Of the picture.
        unit: What the vertical axis counts.
        curves: arm -> its curve; None is left out.
        arms: All arms, in the order of their colours.
    """
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


def over_the_episode(
    title: str, events: Mapping[str, tuple[str, str]], logs: Mapping[str, StepLog], arms: Sequence[str]
) -> Picture:
    """Shares of steps in which something happened, over the step in the episode; a sentence where nothing did.

    Args:
        title: Of the picture.
        events: Flags of `StepLog`, each with its verb and how its line looks.
        logs: arm -> its evaluation steps with the filter on, all seeds and episodes.
        arms: All arms, in the order of their colours.
    """
    said = [
        f"“{arm}”: of {len(log):,} steps "
        + " and ".join(f"{int(getattr(log, event).sum()):,} {verb}" for event, (verb, _) in events.items())
        + "."
        for arm, log in logs.items()
    ]
    if not any(getattr(log, event).any() for log in logs.values() for event in events):
        return Picture(title, " ".join(said))
    last = max(int(log.step.max()) for log in logs.values()) + 1
    edges: Any = np.unique(np.linspace(0, last, min(_EPISODE_BINS, last) + 1).round())

    def paint(axes: Axes) -> None:
        axes.set(xlabel="step in the episode", title="% of steps", xlim=(0, last))
        for arm, log in logs.items():
            steps, _ = np.histogram(log.step, edges)
            for event, (verb, line) in events.items():
                hits, _ = np.histogram(log.step[getattr(log, event)], edges)
                share = 100 * hits / np.where(steps > 0, steps, np.nan)
                label = arm if len(events) == 1 else f"{arm}: {verb}"
                axes.stairs(
                    share, edges, baseline=None, color=color_of(arm, arms), linestyle=line, label=label
                )
        axes.set_ylim(bottom=0)

    return Picture(title, " ".join(said), draw(paint))


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
