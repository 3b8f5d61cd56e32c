"""A learning curve: a metric over training steps, every seed as a faint line."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter, MaxNLocator

from ..evaluation.curves import Curve
from ..evaluation.summary import number
from ..files import Row
from .canvas import arm_color, arm_key, draw
from .picture import Key, Picture, Plotted

_COLUMNS: Final = ("arm", "what", "training_steps", "value")


def curve_picture(
    name: str, title: str, unit: str, curves: Mapping[str, Curve | None], arms: list[str]
) -> Picture:
    """The interquartile mean over seeds as a line, its interval as a band, the seeds as faint lines.

    Args:
        name: Unique on the page.
        title: Of the picture.
        unit: What the vertical axis counts.
        curves: arm -> its curve; None is left out.
        arms: All arms, in the order of their colours.
    """
    there = {arm: curve for arm, curve in curves.items() if curve is not None}
    if not there:
        return Picture(title, "No finished training episode of every seed yet.")
    reading = "; ".join(
        f"“{arm}” {_move(curve)}" if len(there) > 1 else _move(curve) for arm, curve in there.items()
    )
    reading = f"From the first to the last tenth of training: {reading}."

    def paint(axes: Axes) -> None:
        axes.set(xlabel="training steps", title=unit)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.xaxis.set_major_locator(MaxNLocator(6))
        for arm, curve in there.items():
            color = arm_color(arms.index(arm))
            if len(curve.seeds) > 1:
                axes.plot(curve.steps, curve.seeds.T, color=color, linewidth=0.8, alpha=0.35)
            if curve.low is not None and curve.high is not None:
                axes.fill_between(curve.steps, curve.low, curve.high, color=color, alpha=0.14, linewidth=0)
            axes.plot(curve.steps, curve.iqm, color=color, linewidth=2, solid_capstyle="round")

    keys: dict[str, Key] = {arm: (arm_key(arms.index(arm)), "line") for arm in there}
    data = Plotted(name, _COLUMNS, [row for arm, curve in there.items() for row in _rows(arm, curve)])
    return Picture(title, reading, draw(name, f"{title}. {reading}", paint, height=2.6), keys, data)


def _rows(arm: str, curve: Curve) -> Iterator[Row]:
    """Every line of an arm, point by point; `what` is `mean`, `low`, `high`, or `seed 0` and so on."""
    lines = {"mean": curve.iqm, "low": curve.low, "high": curve.high}
    seeds = {f"seed {name}": values for name, values in zip(curve.names, curve.seeds, strict=True)}
    for what, values in (lines | seeds).items():
        if values is not None:
            for steps, value in zip(curve.steps, values, strict=True):
                yield {"arm": arm, "what": what, "training_steps": float(steps), "value": float(value)}


def _move(curve: Curve) -> str:
    tenth = max(1, len(curve.iqm) // 10)
    return f"{number(float(curve.iqm[:tenth].mean()))} to {number(float(curve.iqm[-tenth:].mean()))}"
