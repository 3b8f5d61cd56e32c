"""The numbers that a reader should know after ten seconds: what each policy returned, and what the filter did."""

from __future__ import annotations

from ..config import ExperimentConfig
from ..evaluation.metrics import NOT_JUDGED
from ..evaluation.summary import Summary, number
from .comparison import Comparison, Outcome, Side, compare, filter_time_us
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
    if on.changed is not None:
        parts.append(card("Steps changed", percent(on.changed), "by the filter, in evaluation"))
    fallback = f"fallback: {on.fallback:,} steps"
    parts.append(
        card("Infeasible steps", f"{on.infeasible:,}", f"where no action was admissible, {scope}", fallback)
    )
    time_us = filter_time_us(experiment, found.pairs)
    if time_us is not None:
        parts.append(card("Filter time per step", f"{time_us:,.0f} µs", "mean, on the machine that ran it"))
    # Of several tasks there is no common return.
    returns = [_return(found, outcome) for outcome in found.outcomes] if len(found.pairs) == 1 else []
    rows = [f'<div class="cards returns">{"".join(returns)}</div>'] if returns else []
    rows.append(f'<div class="cards">{"".join(parts)}</div><p class="line">{text(_which(found))}</p>')
    return "".join(rows)


def _return(found: Comparison, outcome: Outcome) -> str:
    """What one arm's policies returned in evaluation with the filter off or on."""
    filtered = outcome.arm.name == found.pairs[0].filtered.name
    trained = "Trained through the filter" if filtered else "Trained without the filter"
    title = f"{outcome.arm.name if found.same_policies else trained}, filter {'on' if outcome.filter_on else 'off'}"
    returns = outcome.returns
    around = []
    if returns.low is not None and returns.high is not None:
        around.append(f"{returns.spread} {number(returns.low)} to {number(returns.high)}")
    if outcome.violations is None:
        hurt = f"violations {NOT_JUDGED}"
    elif outcome.violations:
        hurt = f"{outcome.violations:,} of {outcome.steps:,} steps in violation"
    else:
        hurt = "no step in violation"
    return card(title, number(returns.iqm), "return per episode", *around, hurt)


def _violations(off: Side, on: Side, scope: str) -> str:
    assert on.violations is not None and off.violations is not None  # judged
    mood = "good" if not on.violations and off.violations else "bad" if on.share > off.share else ""
    return card(
        "Steps in violation",
        f"{on.violations:,}",
        f"with the filter, of {on.steps:,} {scope}",
        f"without: {off.violations:,} of {off.steps:,}",
        mood=mood,
    )


def _unsafe(on: Side, scope: str) -> str:
    what = f"by the filter's own measure (h < 0), of {on.steps:,} {scope}"
    return card("Unsafe steps", f"{on.unsafe:,}", what, f"violations: {NOT_JUDGED}")


def _which(found: Comparison) -> str:
    if found.same_policies:
        names = ", ".join(f"“{pair.filtered.name}”" for pair in found.pairs)
        return f"The same policies, {names}, with the filter on and off."
    (pair,) = found.pairs
    return (
        f"With the filter: “{pair.filtered.name}”, trained and evaluated through it."
        f" Without: “{pair.bare.name}”, trained and evaluated bare."
    )
