"""How large the corrections were: a histogram over the steps that the filter changed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter

from ..evaluation.step_log import StepLog
from ..evaluation.summary import number
from ..files import Row
from .canvas import arm_color, arm_key, draw
from .picture import Key, Picture, Plotted, per_arm

_BINS = 30


def corrections_picture(logs: Mapping[str, StepLog], arms: list[str]) -> Picture:
    """Corrections with the filter on, per arm; steps that were left alone are in the sentence only.

    Args:
        logs: arm -> its evaluation steps with the filter on, all seeds.
        arms: All arms, in the order of their colours.
    """
    title = "How large the corrections were"
    changed = {arm: log.correction[log.intervened] for arm, log in logs.items()}
    reading = per_arm({arm: _told(log) for arm, log in logs.items()})
    if not any(len(values) for values in changed.values()):
        return Picture(title, reading)
    edges: Any = np.linspace(
        0, max(float(values.max()) for values in changed.values() if len(values)) or 1.0, _BINS + 1
    )

    def paint(axes: Axes) -> None:
        axes.set(xlabel="correction (L2, action units)", title="steps", yscale="log")
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
        axes.minorticks_off()
        for arm, values in changed.items():
            if len(values):
                color = arm_color(arms.index(arm))
                axes.hist(values, edges, histtype="stepfilled", color=color, alpha=0.22)
                axes.hist(values, edges, histtype="step", color=color, linewidth=1.6)
        axes.set_ylim(bottom=0.7)

    keys: dict[str, Key] = {arm: (arm_key(arms.index(arm)), "fill") for arm in changed if len(changed[arm])}
    rows: list[Row] = [
        {"arm": arm, "from": float(low), "to": float(high), "steps": int(count)}
        for arm, values in changed.items()
        if len(values)
        for low, high, count in zip(edges, edges[1:], np.histogram(values, edges)[0], strict=False)
    ]
    data = Plotted("corrections", ("arm", "from", "to", "steps"), rows)
    return Picture(title, reading, draw(data.name, f"{title}. {reading}", paint), keys, data)


def _told(log: StepLog) -> str:
    values = log.correction[log.intervened]
    if not len(values):
        return f"the filter changed none of {len(log):,} steps"
    untouched = 100 * (1 - len(values) / len(log))
    return (
        f"the filter left {untouched:.3g} % of {len(log):,} steps as they were; of the"
        f" {len(values):,} corrections half were below {number(float(np.median(values)))}, the largest"
        f" {number(float(values.max()))}"
    )
