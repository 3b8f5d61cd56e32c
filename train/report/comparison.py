"""The numbers that the headline compares: one side without the filter, one with it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..config import ArmConfig, ExperimentConfig
from ..evaluation.episode_selection import Pair, compared_pairs
from ..evaluation.evaluate import evaluated_steps
from ..evaluation.summary import Estimate, Summary
from ..run.folder import finished_facts


@dataclass(frozen=True)
class Outcome:
    """What an arm's policies did in evaluation with the filter off or on, all seeds together."""

    arm: ArmConfig
    filter_on: bool
    returns: Estimate
    steps: int
    violations: int | None
    """None: not judged."""


@dataclass(frozen=True)
class Side:
    """One side: training where the arms differ there, and evaluation; totals over all seeds."""

    steps: int
    violations: int | None
    """None: not judged."""
    infeasible: int
    fallback: int
    unsafe: int
    collisions: int
    """0 where the task reports none, too."""
    returns: tuple[Estimate, ...]
    """Of evaluation, one per compared arm; empty if one is missing."""
    changed: float | None
    """Share of evaluation steps that the filter changed."""

    @property
    def share(self) -> float:
        """Of steps in violation."""
        return (self.violations or 0) / self.steps if self.steps else 0.0


@dataclass(frozen=True)
class Comparison:
    """Both sides, and what they are of."""

    pairs: tuple[Pair, ...]
    off: Side
    on: Side
    evaluated: Side
    """Of the side with the filter, evaluation alone."""
    outcomes: tuple[Outcome, ...]
    """In evaluation, of each arm of the pairs with the filter off and on, as far as it is there."""

    @property
    def judged(self) -> bool:
        """Violations were judged on both sides."""
        return self.off.violations is not None and self.on.violations is not None

    @property
    def same_policies(self) -> bool:
        """The two sides differ only in the filter at evaluation."""
        return self.pairs[0].same_policy


def compare(experiment: ExperimentConfig, summary: Summary) -> Comparison | None:
    """The headline's comparison; None where the experiment has no filter, or nothing of a side is there.

    An arm without a filter and one with it count with all their training and the evaluation that is theirs
    (filter off, filter on). Where the policies are the same, only their evaluation is compared.
    """
    pairs = tuple(compared_pairs(experiment))
    if not pairs:
        return None
    training = not pairs[0].same_policy
    off = side(summary, [pair.bare for pair in pairs], "filter_off", training)
    filtered = [pair.filtered for pair in pairs]
    on = side(summary, filtered, "filter_on", training)
    evaluated = side(summary, filtered, "filter_on", training=False)
    arms = dict.fromkeys(arm.name for pair in pairs for arm in (pair.bare, pair.filtered))
    of_name = {arm.name: arm for arm in experiment.arms}
    outcomes = tuple(
        found
        for name in arms
        for filter_on in (False, True)
        if (found := _outcome(summary, of_name[name], filter_on)) is not None
    )
    return Comparison(pairs, off, on, evaluated, outcomes) if off.steps and on.steps else None


def _outcome(summary: Summary, arm: ArmConfig, filter_on: bool) -> Outcome | None:
    condition = "filter_on" if filter_on else "filter_off"
    evaluated = side(summary, [arm], condition, training=False)
    if not evaluated.steps or not evaluated.returns:
        return None
    return Outcome(arm, filter_on, evaluated.returns[0], evaluated.steps, evaluated.violations)


def side(summary: Summary, arms: Sequence[ArmConfig], condition: str, training: bool) -> Side:
    """Totals and returns of some arms under a condition, with or without their training."""
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
        returns=tuple(cell["return"] for cell in cells) if all("return" in cell for cell in cells) else (),
        changed=float(np.mean(rates)) if rates else None,
    )


def filter_time_us(experiment: ExperimentConfig, pairs: Sequence[Pair]) -> float | None:
    """The mean filter call of the filtered side, in training if it was there, else in evaluation."""
    trained, evaluated = [], []
    for pair in pairs:
        for seed in experiment.seeds:
            folder = experiment.run_folder(pair.filtered, seed)
            trained.append(finished_facts(folder).get("filter_time_us"))
            log = evaluated_steps(folder, "filter_on")
            evaluated.append(log.filter_time_us if log is not None else math.nan)
    times = [time for time in trained if time is not None] or [time for time in evaluated if time == time]
    return float(np.mean(times)) if times else None
