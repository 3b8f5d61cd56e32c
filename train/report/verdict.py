"""The verdict in words; it must not say more than the numbers do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..config import ArmConfig, ExperimentConfig
from ..evaluation.episode_selection import Pair, compared_pairs
from ..evaluation.summary import SEEDS_FOR_AN_INTERVAL, Estimate, Summary, judged_by, number


class Side(NamedTuple):
    """What some arms did under a condition, with or without their training; totals over all seeds."""

    steps: int
    violations: int | None  # None: not judged
    infeasible: int
    fallback: int
    unsafe: int
    collisions: int  # 0 where the task reports none, too
    returns: list[Estimate]  # of evaluation, one per arm; empty if one is missing
    changed: float | None  # share of evaluation steps that the filter changed

    @property
    def share(self) -> float:
        """Of steps in violation."""
        return (self.violations or 0) / self.steps if self.steps else 0.0


class Comparison(NamedTuple):
    """Without the filter and with it, and what they are of."""

    pairs: list[Pair]
    off: Side
    on: Side
    evaluated: Side  # of the side with the filter, evaluation alone
    outcomes: dict[
        tuple[str, str], Side
    ]  # (arm, "filter_off" or "filter_on") of a single pair, as far as it is there

    @property
    def judged(self) -> bool:
        """Violations were judged on both sides."""
        return self.off.violations is not None and self.on.violations is not None

    @property
    def same_policies(self) -> bool:
        """The two sides differ only in the filter at evaluation."""
        return self.pairs[0].bare == self.pairs[0].filtered

    def who(self, arm: str) -> str:
        """An arm of a single pair, by how it was trained."""
        if self.same_policies:
            return "The policy"
        through = arm == self.pairs[0].filtered.name
        return "Trained through the filter" if through else "Trained without the filter"


def _side(summary: Summary, arms: Sequence[ArmConfig], condition: str, training: bool = False) -> Side:
    names = [arm.name for arm in arms]
    wanted = (condition, "training") if training else (condition,)
    rows = [row for row in summary.per_seed if row["arm"] in names and row["condition"] in wanted]
    totals = {
        key: int(sum(row.get(key, 0) for row in rows))
        for key in ("steps", "infeasible", "fallback", "unsafe", "collisions")
    }
    judged = all("violations" in row for row in rows)
    cells = [summary.table[name][condition] for name in names]
    rates = [cell["intervention_rate"].iqm for cell in cells if "intervention_rate" in cell]
    return Side(
        **totals,
        violations=int(sum(row["violations"] for row in rows)) if judged else None,
        returns=[cell["return"] for cell in cells] if all("return" in cell for cell in cells) else [],
        changed=float(np.mean(rates)) if rates else None,
    )


def compare(experiment: ExperimentConfig, summary: Summary) -> Comparison | None:
    """The headline's comparison; None where the experiment has no filter, or nothing of a side is there.

    An arm without a filter and one with it count with all their training and the evaluation that is theirs
    (filter off, filter on). Where the policies are the same, only their evaluation is compared.
    """
    pairs = compared_pairs(experiment)
    if not pairs:
        return None
    training = pairs[0].bare != pairs[0].filtered
    filtered = [pair.filtered for pair in pairs]
    off = _side(summary, [pair.bare for pair in pairs], "filter_off", training)
    on = _side(summary, filtered, "filter_on", training)
    if not off.steps or not on.steps:
        return None
    outcomes = {
        (arm.name, condition): side
        for arm in (pairs[0] if len(pairs) == 1 else ())  # of several tasks there is no common return
        for condition in ("filter_off", "filter_on")
        if (side := _side(summary, [arm], condition)).returns and side.steps
    }
    return Comparison(pairs, off, on, _side(summary, filtered, "filter_on"), outcomes)


def verdict(experiment: ExperimentConfig, summary: Summary) -> list[str]:
    """Whether the filter kept the limits, what that cost, and how often it stepped in; the main point first.

    Where an arm was trained without the filter and one through it, all four returns are told: of either policy
    without and with the filter.
    """
    found = compare(experiment, summary)
    judge = judged_by(experiment, summary.judged)
    if found is None:
        return [part for part in ("There is no filter to compare with yet.", judge) if part]
    first = [_safety(found.off, found.on), judge] if found.judged else [judge, _own_measure(found.on)]
    collisions = ""
    if found.off.collisions or found.on.collisions:
        collisions = f"Collisions begun: {found.on.collisions:,} with it, {found.off.collisions:,} without."
    return [part for part in (*first, collisions, *_price(found), _work(found.on, found.evaluated)) if part]


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
    through = f"{on.violations:,} of {on.steps:,} steps ({percent(on.share)}) with it, {without} without."
    if on.share < off.share:
        return f"The filter lowered violations without removing them: {through}"
    return f"The filter did not lower violations: {through}"


def _own_measure(on: Side) -> str:
    outside = f"{on.unsafe:,} of {on.steps:,} steps" if on.unsafe else f"none of {on.steps:,} steps"
    return f"By the filter's own measure {outside} with it began outside the safe set."


def _price(found: Comparison) -> list[str]:
    if len(found.pairs) > 1:
        went = [
            f"{pair.filtered.name} {number(off.iqm)} to {number(on.iqm)}"
            for pair, off, on in zip(found.pairs, found.off.returns, found.on.returns, strict=False)
        ]
        return [f"The return per episode went: {', '.join(went)}."] if went else []
    return [_returns(found), _choice(found)]


def _returns(found: Comparison) -> str:
    """What either policy returned in evaluation, without and with the filter."""
    told = []
    for (arm, condition), side in found.outcomes.items():
        told.append(f"{found.who(arm)}, {condition.replace('_', ' ')} {side.returns[0]}")
        if side.violations is not None:
            told[-1] += f" with {side.violations:,} of {side.steps:,} steps in violation"
    return f"Return per evaluation episode: {'; '.join(told)}." if told else ""


def _choice(found: Comparison) -> str:
    """Whether it paid to train through the filter that is on afterwards; nothing where that was not tried."""
    acting = [side.returns[0] for (_, condition), side in found.outcomes.items() if condition == "filter_on"]
    if len(acting) < 2:
        return ""
    added, through = acting
    if added.iqm == through.iqm:
        return "With the filter on, both returned the same."
    better = "trained without it" if added.iqm > through.iqm else "trained through it"
    seeds = min(added.seeds, through.seeds)
    surely = "one seed says little" if seeds < 2 else f"{seeds} seeds say little"
    if seeds >= SEEDS_FOR_AN_INTERVAL:
        apart = max(added.low or 0.0, through.low or 0.0) > min(added.high or 0.0, through.high or 0.0)
        surely = f"the intervals over {seeds} seeds {'lie apart' if apart else 'overlap'}"
    return f"With the filter on, the policy {better} returned more ({surely})."


def _work(on: Side, evaluated: Side) -> str:
    """What the filter did in evaluation, and then, where it was on in training and failed there, how often."""
    rest = "no step was infeasible and none ran the fallback"
    if evaluated.infeasible or evaluated.fallback:
        rest = _failed(evaluated.infeasible, evaluated.fallback)
    said = f"In evaluation {rest}."
    if evaluated.changed is not None:
        changed = percent(evaluated.changed) if evaluated.changed else "none"
        said = f"The filter changed {changed} of the evaluation steps; {rest}."
    infeasible, fallback = on.infeasible - evaluated.infeasible, on.fallback - evaluated.fallback
    if infeasible or fallback:
        said += f" In training {_failed(infeasible, fallback)}, of {on.steps - evaluated.steps:,}."
    return said


def _failed(infeasible: int, fallback: int) -> str:
    were = "step was" if infeasible == 1 else "steps were"
    return f"{infeasible:,} {were} infeasible and {fallback:,} ran the fallback"
