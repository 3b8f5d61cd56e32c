"""The five numbers that a reader should know after ten seconds."""

from __future__ import annotations

from ..config import ExperimentConfig
from ..summary import Summary, number
from .comparison import Comparison, Side, compare, filter_time_us
from .markup import card, text
from .verdict import percent


def cards(experiment: ExperimentConfig, summary: Summary) -> str:
    """The big numbers and what they compare; empty where there is no filter to compare with."""
    found = compare(experiment, summary)
    if found is None:
        return ""
    off, on = found.off, found.on
    scope = "of evaluation" if found.same_policies else "of training and evaluation"
    parts = [_violations(off, on, scope) if found.judged else _unsafe(on, scope)]
    if len(on.returns) == len(off.returns) == 1:
        value, without = number(on.returns[0].iqm), number(off.returns[0].iqm)
        parts.append(
            card("Return per episode", value, "with the filter, in evaluation", f"without: {without}")
        )
    if on.changed is not None:
        parts.append(card("Steps changed", percent(on.changed), "by the filter, in evaluation"))
    fallback = f"fallback: {on.fallback:,} steps"
    parts.append(card("Infeasible steps", f"{on.infeasible:,}", "where no action was admissible", fallback))
    time_us = filter_time_us(experiment, found.pairs)
    if time_us is not None:
        parts.append(card("Filter time per step", f"{time_us:,.0f} µs", "mean, on the machine that ran it"))
    return f'<div class="cards">{"".join(parts)}</div><p class="line">{text(_which(found))}</p>'


def _violations(off: Side, on: Side, scope: str) -> str:
    mood = "good" if not on.violations and off.violations else "bad" if on.share > off.share else ""
    return card(
        "Steps in violation",
        f"{on.violations:,}",
        f"with the filter, of {on.steps:,} {scope}",
        f"without: {off.violations:,} of {off.steps:,}",
        mood,
    )


def _unsafe(on: Side, scope: str) -> str:
    what = f"by the filter's own measure (h < 0), of {on.steps:,} {scope}"
    return card("Unsafe steps", f"{on.unsafe:,}", what, "the task reports no cost")


def _which(found: Comparison) -> str:
    if found.same_policies:
        names = ", ".join(f"“{pair.filtered.name}”" for pair in found.pairs)
        return f"The same policies, {names}, with the filter on and off."
    (pair,) = found.pairs
    return (
        f"With the filter: “{pair.filtered.name}”, trained and evaluated through it."
        f" Without: “{pair.bare.name}”, trained and evaluated bare."
    )
