"""How the cost of a decision grows, as `python -m benchmarks.scaling` has measured it."""

import json
from pathlib import Path

from matplotlib.figure import Figure

from _style import INK, OFF, ON, OTHER, SAFE, panels

MEASURED = Path(__file__).parents[2] / "benchmarks" / "results" / "scaling.json"
ONE_DECISION = {"discs": ON, "rows": SAFE, "constraints": OTHER, "look-ahead": OFF}


def draw() -> Figure:
    """Left: one decision. Right: one step of one env among many."""
    found = json.loads(MEASURED.read_text())
    figure, (one, many) = panels(2, height=3.2)
    for name, color in ONE_DECISION.items():
        one.plot(*zip(*found[name], strict=True), "o-", color=color, ms=3, label=name)
    for (name, curve), color in zip(
        ((n, c) for n, c in found.items() if n.startswith("envs")), (INK, ON, OFF), strict=False
    ):
        many.plot(*zip(*curve, strict=True), "o-", color=color, ms=3, label=name.removeprefix("envs, "))
    for ax, title, below in (
        (one, "one decision", "discs, rows, ... (steps of the look-ahead)"),
        (many, "one step of one env", "envs in one process"),
    ):
        ax.set(xscale="log", yscale="log", title=title, xlabel=below, ylabel="us")
        ax.legend()
    many.set_ylim(bottom=10.0)
    return figure
