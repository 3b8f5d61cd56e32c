"""When in an episode the filter stepped in, and when it found nothing admissible."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from ..evaluation.step_log import StepLog
from ..tables import Row
from .canvas import arm_color, arm_key, draw
from .picture import Key, Look, Picture, Plotted, per_arm

_BINS: Final = 20
_LOOKS: Final[dict[str, tuple[str, Look]]] = {
    "intervened": ("-", "line"),
    "infeasible": ("-", "line"),
    "fallback": (":", "dot"),
}


def changes_picture(logs: Mapping[str, StepLog], arms: list[str]) -> Picture:
    """Shares of steps that the filter changed, over the step in the episode.

    Args:
        logs: arm -> its evaluation steps with the filter on, all seeds and episodes.
        arms: All arms, in the order of their colours.
    """
    title = "When in an episode it stepped in"
    told = {
        arm: f"of {len(log):,} steps {int(log.intervened.sum()):,} were changed" for arm, log in logs.items()
    }
    return _timeline("episode-changes", title, "% of steps", logs, ("intervened",), told, arms)


def failures_picture(logs: Mapping[str, StepLog], arms: list[str]) -> Picture:
    """Infeasible and fallback steps per 1000 steps, over the step in the episode; a line where there are none.

    Args:
        logs: arm -> its evaluation steps with the filter on, all seeds and episodes.
        arms: All arms, in the order of their colours.
    """
    title = "Infeasible and fallback steps in evaluation"
    told = {
        arm: f"of {len(log):,} steps {int(log.infeasible.sum()):,} were infeasible"
        f" and {int(log.fallback.sum()):,} ran the fallback"
        for arm, log in logs.items()
    }
    return _timeline(
        "episode-failures", title, "per 1000 steps", logs, ("infeasible", "fallback"), told, arms
    )


def _timeline(
    name: str,
    title: str,
    unit: str,
    logs: Mapping[str, StepLog],
    events: tuple[str, ...],
    told: Mapping[str, str],
    arms: list[str],
) -> Picture:
    reading = per_arm(told)
    shown = [(arm, event) for arm, log in logs.items() for event in events if getattr(log, event).any()]
    if not shown:
        return Picture(title, reading)
    last = max(int(log.step.max()) for log in logs.values())
    edges = np.unique(np.linspace(0, last + 1, min(_BINS, last + 1) + 1).round())
    scale = 100.0 if unit.startswith("%") else 1000.0
    shares = {(arm, event): scale * _shares(logs[arm], event, edges) for arm, event in shown}

    def paint(axes: Axes) -> None:
        axes.set_xlabel("step in the episode")
        axes.set_title(unit)
        for (arm, event), values in shares.items():
            color = arm_color(arms.index(arm))
            axes.stairs(values, edges, baseline=None, color=color, linestyle=_LOOKS[event][0], linewidth=1.6)
        axes.set_ylim(bottom=0)
        axes.set_xlim(0, last + 1)

    keys: dict[str, Key] = {
        arm if len(events) == 1 else f"{arm}: {event}": (arm_key(arms.index(arm)), _LOOKS[event][1])
        for arm, event in shown
    }
    column = "percent_of_steps" if scale == 100.0 else "per_1000_steps"
    rows: list[Row] = [
        {"arm": arm, "event": event, "from_step": int(first), "to_step": int(end), column: float(value)}
        for (arm, event), values in shares.items()
        for first, end, value in zip(edges, edges[1:], values, strict=False)
    ]
    data = Plotted(name, ("arm", "event", "from_step", "to_step", column), rows)
    return Picture(title, reading, draw(name, f"{title}. {reading}", paint, height=2.6), keys, data)


def _shares(log: StepLog, event: str, edges: NDArray[np.floating]) -> NDArray[np.float64]:
    """Of the steps in each bin; NaN where no episode came that far."""
    steps, _ = np.histogram(log.step, edges)
    hits, _ = np.histogram(log.step[getattr(log, event)], edges)
    shares = np.full(len(steps), np.nan)
    np.divide(hits, steps, out=shares, where=steps > 0)
    return shares
