"""Which constraint refused how many of the policy's actions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
from matplotlib.axes import Axes

from ..evaluation.step_log import StepLog
from ..files import Row
from .canvas import arm_color, arm_key, draw
from .picture import Key, Picture, Plotted, per_arm

_IDLE: Final = "if that is a surprise: a limit may be out of reach, or in another unit; angles are in rad"


def constraints_picture(logs: Mapping[str, StepLog], arms: list[str]) -> Picture:
    """Shares of steps in which each constraint refused the (boxed) proposal; they may overlap.

    Args:
        logs: arm -> its evaluation steps with the filter on, all seeds.
        arms: All arms, in the order of their colours.
    """
    title = "Which constraint refused"
    logs = {arm: log for arm, log in logs.items() if len(log.constraint_names)}
    if not logs:
        return Picture(title, "This filter does not say which of its constraints refused an action.")
    shares = {
        arm: dict(zip(map(str, log.constraint_names), 100 * log.refused.mean(axis=0), strict=True))
        for arm, log in logs.items()
    }
    names = list(dict.fromkeys(name for of_arm in shares.values() for name in of_arm))
    reading = per_arm({arm: _told(logs[arm], shares[arm]) for arm in shares})
    if len(names) == 1:
        return Picture(title, reading)

    def paint(axes: Axes) -> None:
        axes.set_xlabel("% of steps")
        axes.grid(False, axis="y")
        thick = 0.8 / len(shares)
        places = np.arange(len(names))
        for at, (arm, of_arm) in enumerate(shares.items()):
            offsets = places + thick * (at - (len(shares) - 1) / 2)
            values = [of_arm.get(name, 0.0) for name in names]
            bars = axes.barh(offsets, values, thick * 0.9, color=arm_color(arms.index(arm)), alpha=0.85)
            axes.bar_label(bars, [f"{value:.2g} %" for value in values], padding=3)
        axes.set_yticks(places, names)
        axes.tick_params(axis="y", length=0)
        axes.invert_yaxis()
        axes.margins(x=0.15)
        axes.set_xlim(left=0)

    keys: dict[str, Key] = {arm: (arm_key(arms.index(arm)), "fill") for arm in shares}
    height = 0.8 + 0.35 * len(names) * max(1.0, 0.6 * len(shares))
    rows: list[Row] = [
        {"arm": arm, "constraint": name, "percent_of_steps": float(share)}
        for arm, of_arm in shares.items()
        for name, share in of_arm.items()
    ]
    data = Plotted("constraints", ("arm", "constraint", "percent_of_steps"), rows)
    return Picture(title, reading, draw(data.name, f"{title}. {reading}", paint, height), keys, data)


def _told(log: StepLog, shares: Mapping[str, float]) -> str:
    idle = ", ".join(name for name, share in shares.items() if share == 0.0)
    never = f"; never acted: {idle} ({_IDLE})" if idle else ""
    if not log.refused.any():
        return f"no constraint refused any of {len(log):,} actions{never}"
    parts = [
        f"{name} {share:.2g} %"
        for name, share in sorted(shares.items(), key=lambda item: -item[1])
        if share > 0.0
    ]
    both = 100 * float((log.refused.sum(axis=1) > 1).mean())
    overlap = f"; in {both:.2g} % more than one did" if len(parts) > 1 else ""
    return f"of {len(log):,} actions refused by {', '.join(parts)}{overlap}{never}"
