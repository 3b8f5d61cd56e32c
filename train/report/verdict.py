"""The verdict in words; it must not say more than the numbers do."""

from __future__ import annotations

from ..config import ExperimentConfig
from ..summary import Estimate, Summary, number
from .comparison import Comparison, Side, compare, side


def verdict(experiment: ExperimentConfig, summary: Summary) -> str:
    """Whether the filter kept the limits, what that cost, and how often it stepped in."""
    found = compare(experiment, summary)
    if found is None:
        return _without_comparison(experiment, summary)
    safety = _safety(found.off, found.on) if found.judged else _own_measure(found.on)
    return " ".join(filter(None, (safety, _collisions(found.off, found.on), _price(found), _work(found.on))))


def percent(share: float) -> str:
    """A share in percent; two digits below ten, and nothing that was there becomes 0 %."""
    value = 100 * share
    if 0 < value < 0.01:
        return "less than 0.01 %"
    return f"{value:.2g} %" if value < 10 else f"{value:.0f} %"


def _safety(off: Side, on: Side) -> str:
    without = f"{off.violations:,} of {off.steps:,} steps ({percent(off.share)})"
    if not on.violations and off.violations:
        return f"With the filter none of {on.steps:,} steps was in violation; without it {without} were."
    if not on.violations:
        return "No violation with the filter, and none without it: the task did not put it to the test."
    with_filter = f"{on.violations:,} of {on.steps:,} steps ({percent(on.share)})"
    if on.share < off.share:
        return (
            f"The filter lowered violations without removing them: {with_filter} with it, {without} without."
        )
    return f"The filter did not lower violations: {with_filter} with it, {without} without."


def _collisions(off: Side, on: Side) -> str:
    if not off.collisions and not on.collisions:
        return ""
    return f"Collisions begun: {on.collisions:,} with it, {off.collisions:,} without."


def _own_measure(on: Side) -> str:
    outside = f"{on.unsafe:,} of {on.steps:,} steps" if on.unsafe else f"none of {on.steps:,} steps"
    return (
        "The task reports no cost, so violations cannot be counted; by the filter's own measure"
        f" {outside} with it began outside the safe set."
    )


def _price(found: Comparison) -> str:
    if not found.off.returns or not found.on.returns:
        return ""
    if len(found.pairs) > 1:
        # Returns of different tasks have no common mean.
        told = (
            f"{pair.filtered.name} {number(off.iqm)} to {number(on.iqm)}"
            for pair, off, on in zip(found.pairs, found.off.returns, found.on.returns, strict=True)
        )
        return f"The return per episode went: {', '.join(told)}."
    (off,), (on,) = found.off.returns, found.on.returns
    numbers = f"from {number(off.iqm)} to {number(on.iqm)}"
    intervals = _overlap(off, on)
    if off.iqm <= 0:
        return f"The return per episode went {numbers} ({intervals})."
    change = 100 * (on.iqm / off.iqm - 1)
    if abs(change) < 0.5:
        return f"The return per episode stayed the same ({numbers}; {intervals})."
    direction = "lower" if change < 0 else "higher"
    return f"The return per episode was {abs(change):.0f} % {direction} ({numbers}; {intervals})."


def _overlap(off: Estimate, on: Estimate) -> str:
    if off.low is None or off.high is None or on.low is None or on.high is None:
        return "one seed says little"
    apart = off.low > on.high or on.low > off.high
    seeds = min(off.seeds, on.seeds)
    return f"the intervals over {seeds} seeds {'lie apart' if apart else 'overlap'}"


def _work(on: Side) -> str:
    if not on.infeasible and not on.fallback:
        rest = "no step was infeasible and none ran the fallback"
    else:
        rest = f"{on.infeasible:,} steps were infeasible and {on.fallback:,} ran the fallback"
    if on.changed is None:
        return f"{rest[:1].upper()}{rest[1:]}."
    return f"It changed {percent(on.changed) if on.changed else 'none'} of the evaluation steps; {rest}."


def _without_comparison(experiment: ExperimentConfig, summary: Summary) -> str:
    parts = ["There is no filter to compare with yet."]
    for arm in experiment.arms:
        for condition, words in (("filter_off", "in evaluation"), ("training", "while training")):
            alone = side(summary, [arm], condition, training=False)
            if alone.steps and alone.returns:
                parts.append(
                    f"{arm.name}: return {number(alone.returns[0].iqm)} {words}, {alone.violations:,} of"
                    f" {alone.steps:,} steps in violation."
                )
                break
    return " ".join(parts)
