"""The verdict in words; it must not say more than the numbers do."""

from __future__ import annotations

from collections.abc import Sequence

from ..config import ExperimentConfig
from ..evaluation.has_cost import judged_by
from ..evaluation.summary import SEEDS_FOR_AN_INTERVAL, Estimate, Summary, number, spread
from .comparison import Comparison, Outcome, Side, compare, side


def verdict(experiment: ExperimentConfig, summary: Summary) -> list[str]:
    """Whether the filter kept the limits, what that cost, and how often it stepped in; the main point first.

    Where an arm was trained without the filter and one through it, all four returns are told: of either policy
    without and with the filter.
    """
    found = compare(experiment, summary)
    if found is None:
        return _without_comparison(experiment, summary)
    judge = judged_by(experiment, found.judged)
    parts = (
        *((_safety(found.off, found.on), judge) if found.judged else (judge, _own_measure(found.on))),
        _collisions(found.off, found.on),
        *_price(found),
        _work(found.on, found.evaluated),
    )
    return [part for part in parts if part]


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
    return f"By the filter's own measure {outside} with it began outside the safe set."


def _price(found: Comparison) -> list[str]:
    if len(found.pairs) > 1:
        if not found.off.returns or not found.on.returns:
            return []
        # Returns of different tasks have no common mean.
        went = (
            f"{pair.filtered.name} {number(off.iqm)} to {number(on.iqm)}"
            for pair, off, on in zip(found.pairs, found.off.returns, found.on.returns, strict=True)
        )
        return [f"The return per episode went: {', '.join(went)}."]
    if not found.outcomes:
        return []
    told = [_policy(found, arm) for arm in dict.fromkeys(outcome.arm.name for outcome in found.outcomes)]
    return [*told, " ".join(filter(None, (_choice(found), _brackets(found.outcomes), _training(found))))]


def _policy(found: Comparison, name: str) -> str:
    """What one arm's policies returned in evaluation, without and with the filter."""
    if found.same_policies:
        who, phrases = "The policy", ("without the filter", "with it")
    elif name == found.pairs[0].filtered.name:
        who, phrases = "Trained through the filter, the policy", ("with it taken off", "with it")
    else:
        who, phrases = "Trained without the filter, the policy", ("without it", "with it added afterwards")
    parts = [
        f"{_with_spread(outcome.returns)} {phrases[outcome.filter_on]}{_violations(outcome)}"
        for outcome in found.outcomes
        if outcome.arm.name == name
    ]
    return f"{who} returned per evaluation episode {' and '.join(parts)}."


def _with_spread(returns: Estimate) -> str:
    return number(returns.iqm) if returns.low is None else str(returns)


def _violations(outcome: Outcome) -> str:
    if outcome.violations is None:
        return ""
    if not outcome.violations:
        return " (no step in violation)"
    share = percent(outcome.violations / outcome.steps)
    return f" ({outcome.violations:,} of {outcome.steps:,} steps in violation, {share})"


def _choice(found: Comparison) -> str:
    """Whether it paid to train through the filter that is on afterwards; nothing where that was not tried."""
    acting = [outcome for outcome in found.outcomes if outcome.filter_on]
    if len(acting) < 2:
        return ""
    added, through = (outcome.returns for outcome in acting)
    if added.iqm == through.iqm:
        return "With the filter on, both returned the same."
    better = "trained without it" if added.iqm > through.iqm else "trained through it"
    return f"With the filter on, the policy {better} returned more ({_how_surely(added, through)})."


def _how_surely(one: Estimate, other: Estimate) -> str:
    seeds = min(one.seeds, other.seeds)
    if spread(seeds) != "95 % interval":
        return "one seed says little" if seeds < 2 else f"{seeds} seeds say little"
    assert one.low is not None and one.high is not None and other.low is not None and other.high is not None
    apart = one.low > other.high or other.low > one.high
    return f"the intervals over {seeds} seeds {'lie apart' if apart else 'overlap'}"


def _brackets(outcomes: Sequence[Outcome]) -> str:
    counts = [outcome.returns.seeds for outcome in outcomes]
    if max(counts) < 2:
        return "One seed: no interval."
    if max(counts) < SEEDS_FOR_AN_INTERVAL:
        return f"In brackets the range over {max(counts)} seeds, which is not an interval."
    rest = "" if min(counts) >= SEEDS_FOR_AN_INTERVAL else ", of two seeds their range"
    return f"In brackets bootstrap 95 % intervals over seeds{rest}."


def _training(found: Comparison) -> str:
    """For how long the compared policies were trained."""
    arms = {arm.name: arm for pair in found.pairs for arm in (pair.bare, pair.filtered)}
    lengths = [f"{arm.total_steps * arm.action_repeat:,}" for arm in arms.values()]
    if len(set(lengths)) == 1:
        return f"Trained for {lengths[0]} control steps{' each' if len(lengths) > 1 else ''}."
    return f"Trained for {' and '.join(lengths)} control steps."


def _work(on: Side, evaluated: Side) -> str:
    """What the filter did in evaluation, and then, where it was on in training and failed there, how often."""
    if evaluated.infeasible or evaluated.fallback:
        rest = _failed(evaluated.infeasible, evaluated.fallback)
    else:
        rest = "no step was infeasible and none ran the fallback"
    if evaluated.changed is None:
        in_evaluation = f"In evaluation {rest}."
    else:
        changed = percent(evaluated.changed) if evaluated.changed else "none"
        in_evaluation = f"The filter changed {changed} of the evaluation steps; {rest}."
    infeasible, fallback = on.infeasible - evaluated.infeasible, on.fallback - evaluated.fallback
    if not infeasible and not fallback:
        return in_evaluation
    steps = on.steps - evaluated.steps
    return f"{in_evaluation} In training {_failed(infeasible, fallback)}, of {steps:,}."


def _failed(infeasible: int, fallback: int) -> str:
    were = "step was" if infeasible == 1 else "steps were"
    return f"{infeasible:,} {were} infeasible and {fallback:,} ran the fallback"


def _without_comparison(experiment: ExperimentConfig, summary: Summary) -> list[str]:
    parts = ["There is no filter to compare with yet."]
    for arm in experiment.arms:
        for condition, words in (("filter_off", "in evaluation"), ("training", "while training")):
            alone = side(summary, [arm], condition, training=False)
            if alone.steps and alone.returns:
                judged = (
                    ""
                    if alone.violations is None
                    else f", {alone.violations:,} of {alone.steps:,} steps in violation"
                )
                parts.append(f"{arm.name}: return {number(alone.returns[0].iqm)} {words}{judged}.")
                break
    return [part for part in (*parts, judged_by(experiment, summary.judged)) if part]
