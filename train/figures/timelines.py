"""When the filter stepped in, and when it found nothing admissible: in an episode, and while training."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter, MaxNLocator
from numpy.typing import NDArray

from safe_wrappers.checks import Array

from ..evaluation.step_log import StepLog
from ..files import Row
from .canvas import arm_color, arm_key, draw
from .picture import Key, Look, Picture, Plotted, per_arm

Rate = tuple[Array, Array, int]
"""What `event_rate` returns."""
Stairs = Mapping[tuple[str, str], tuple[NDArray[np.number], Array]]
"""(arm, event) -> edges of bins of steps, shape (B + 1,), and values in them, shape (B,)."""
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
    return _in_an_episode("episode-changes", title, "% of steps", logs, ("intervened",), told, arms)


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
    return _in_an_episode(
        "episode-failures", title, "per 1000 steps", logs, ("infeasible", "fallback"), told, arms
    )


def training_timeline_picture(
    rates: Mapping[str, Mapping[str, Rate]], steps: int, arms: list[str]
) -> Picture:
    """Infeasible and fallback steps per 1000 steps, over training.

    Args:
        rates: "infeasible" and "fallback" -> filtered arm -> its rate.
        steps: Training steps of these arms, all seeds.
        arms: All arms, in the order of their colours.
    """
    title = "Infeasible and fallback steps while training"
    counts = {what: sum(rate[2] for rate in of_arms.values()) for what, of_arms in rates.items()}
    if not any(counts.values()):
        return Picture(
            title, f"None: in {steps:,} training steps none was infeasible and none ran the fallback."
        )
    reading = (
        f"Of {steps:,} training steps {counts['infeasible']:,} were infeasible and {counts['fallback']:,} ran the"
        " fallback."
    )

    def label(axes: Axes) -> None:
        axes.set_xlabel("training steps")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.xaxis.set_major_locator(MaxNLocator(6))

    events = ("infeasible", "fallback")
    stairs = {
        (arm, what): rates[what][arm][:2] for what in events for arm in rates[what] if rates[what][arm][2]
    }
    return _timeline("training-timeline", title, "per 1000 steps", reading, stairs, arms, label)


def _in_an_episode(
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
    edges = np.unique(np.linspace(0, last + 1, min(_BINS, last + 1) + 1).round()).astype(int)
    scale = 100.0 if unit.startswith("%") else 1000.0
    stairs = {(arm, event): (edges, scale * _shares(logs[arm], event, edges)) for arm, event in shown}

    def label(axes: Axes) -> None:
        axes.set(xlabel="step in the episode", xlim=(0, last + 1))

    return _timeline(name, title, unit, reading, stairs, arms, label)


def _timeline(
    name: str,
    title: str,
    unit: str,
    reading: str,
    stairs: Stairs,
    arms: list[str],
    label: Callable[[Axes], None],
) -> Picture:
    def paint(axes: Axes) -> None:
        axes.set_title(unit)
        label(axes)
        for (arm, event), (edges, values) in stairs.items():
            color = arm_color(arms.index(arm))
            axes.stairs(values, edges, baseline=None, color=color, linestyle=_LOOKS[event][0], linewidth=1.6)
        axes.set_ylim(bottom=0)

    keys: dict[str, Key] = {
        arm if event == "intervened" else f"{arm}: {event}": (arm_key(arms.index(arm)), _LOOKS[event][1])
        for arm, event in stairs
    }
    column = "percent_of_steps" if unit.startswith("%") else "per_1000_steps"
    rows: list[Row] = [
        {"arm": arm, "event": event, "from_step": first.item(), "to_step": end.item(), column: float(value)}
        for (arm, event), (edges, values) in stairs.items()
        for first, end, value in zip(edges, edges[1:], values, strict=False)
    ]
    data = Plotted(name, ("arm", "event", "from_step", "to_step", column), rows)
    return Picture(title, reading, draw(name, f"{title}. {reading}", paint, height=2.6), keys, data)


def _shares(log: StepLog, event: str, edges: NDArray[np.number]) -> Array:
    """Of the steps in each bin; NaN where no episode came that far."""
    steps, _ = np.histogram(log.step, edges)
    hits, _ = np.histogram(log.step[getattr(log, event)], edges)
    shares = np.full(len(steps), np.nan)
    np.divide(hits, steps, out=shares, where=steps > 0)
    return shares
