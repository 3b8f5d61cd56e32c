"""When in training the filter found no admissible action, and when its fallback acted."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter, MaxNLocator
from numpy.typing import NDArray

from ..tables import Row
from .canvas import arm_color, arm_key, draw
from .picture import Key, Picture, Plotted

Rate = tuple[NDArray[np.float64], NDArray[np.float64], int]
"""What `event_rate` returns."""
_LOOKS: Final = {"infeasible": "-", "fallback": ":"}


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
    shown = {(arm, what): rates[what][arm] for what in _LOOKS for arm in rates[what] if rates[what][arm][2]}

    def paint(axes: Axes) -> None:
        axes.set_xlabel("training steps")
        axes.set_title("per 1000 steps")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.xaxis.set_major_locator(MaxNLocator(6))
        for (arm, what), (edges, values, _) in shown.items():
            axes.stairs(
                values,
                edges,
                baseline=None,
                color=arm_color(arms.index(arm)),
                linestyle=_LOOKS[what],
                linewidth=1.6,
            )
        axes.set_ylim(bottom=0)

    keys: dict[str, Key] = {
        f"{arm}: {what}": (arm_key(arms.index(arm)), "line" if what == "infeasible" else "dot")
        for arm, what in shown
    }
    rows: list[Row] = [
        {
            "arm": arm,
            "event": what,
            "from_step": float(first),
            "to_step": float(end),
            "per_1000_steps": float(rate),
        }
        for (arm, what), (edges, values, _) in shown.items()
        for first, end, rate in zip(edges, edges[1:], values, strict=False)
    ]
    data = Plotted("training-timeline", ("arm", "event", "from_step", "to_step", "per_1000_steps"), rows)
    return Picture(title, reading, draw(data.name, f"{title}. {reading}", paint, height=2.6), keys, data)
