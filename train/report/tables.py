"""The numbers as rows, for the page and as a table on the terminal, and in words, which must not say more."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from rich.markup import escape
from rich.table import Table

from ..config.models import ArmConfig, ExperimentConfig
from ..evaluation.evaluate import Pair, compared_pairs
from ..evaluation.metrics import METRICS, NOT_JUDGED, OF_THE_JUDGE
from ..evaluation.summary import (
    CONDITIONS,
    SEEDS_FOR_AN_INTERVAL,
    Estimate,
    Summary,
    judged_by,
    number,
    over_seeds,
)

SHORT: Final = {
    "return": "Return / episode",
    "cost": "Cost / episode",
    "violations": "Steps in violation",
    "intervention_rate": "Steps changed",
    "infeasible": "Infeasible",
    "fallback": "Fallback",
}
"""The short table's numbers and their headings."""


class Cell(NamedTuple):
    """A value, what stands small beside it, and whether it is "good" or "bad"."""

    value: str
    small: str = ""
    mood: str = ""


def every_metric(experiment: ExperimentConfig, summary: Summary) -> Iterator[tuple[str, list[Cell]]]:
    """Every metric, arms side by side; a row without cells is the heading of a condition."""
    for condition, title in CONDITIONS.items():
        cells = [summary.table[arm.name][condition] for arm in experiment.arms]
        if any(cells):
            yield title, []
        for metric, label in METRICS.items():
            # A reader looks for cost and violations, and is told if they are not judged.
            if any(cells) and (metric in ("cost", "violations") or any(metric in cell for cell in cells)):
                yield label, [_estimate(cell, metric) for cell in cells]


def comparison_table(experiment: ExperimentConfig, summary: Summary) -> Table:
    """Arms side by side, a section per condition; a mean over seeds, and its range or interval."""
    judge = judged_by(experiment, summary.judged)
    table = Table(title=escape(f"{experiment.name}: {over_seeds(*summary.seeds)}"), caption=judge or None)
    table.add_column("")
    for arm in experiment.arms:
        table.add_column(arm.name, justify="right")
    for title, cells in every_metric(experiment, summary):
        if not cells:
            table.add_section()
        row = [escape(f"{cell.value} {cell.small}".strip()) for cell in cells]
        table.add_row(f"  {title}" if cells else f"[bold]{title}[/bold]", *row)
    return table


def short_rows(summary: Summary, arm: ArmConfig) -> Iterator[tuple[str, list[Cell]]]:
    """A row per condition of an arm: what was bought, what was paid, how often the filter stepped in."""
    for condition, title in CONDITIONS.items():
        cell = summary.table[arm.name][condition]
        if not cell:
            continue
        side = _side(summary, [arm], condition)
        violations, changed = Cell(NOT_JUDGED), [Cell("-")] * 3
        if side.violations is not None:
            mood = "bad" if side.violations else "good"
            violations = Cell(f"{side.violations:,}", f"of {side.steps:,}", mood)
        if side.changed is not None:
            share = Cell(f"{100 * side.changed:.3g} %")
            changed = [share, Cell(f"{side.infeasible:,}"), Cell(f"{side.fallback:,}")]
        yield title, [_estimate(cell, "return"), _estimate(cell, "cost"), violations, *changed]


def _estimate(cell: Mapping[str, Estimate], metric: str) -> Cell:
    value = cell.get(metric)
    if value is None:
        return Cell(NOT_JUDGED if cell and metric in OF_THE_JUDGE else "-")
    whole = str(value)
    return Cell(number(value.iqm), whole[whole.index("[") :])


class Side(NamedTuple):
    """What some arms did under a condition, with or without their training; totals over all seeds."""

    steps: int
    violations: int | None  # None: not judged
    infeasible: int
    fallback: int
    unsafe: int
    returns: list[Estimate]  # of evaluation, one per arm; empty if one is missing
    changed: float | None  # share of evaluation steps that the filter changed

    @property
    def share(self) -> float:
        """Of steps in violation."""
        return (self.violations or 0) / self.steps if self.steps else 0.0


def _side(summary: Summary, arms: Sequence[ArmConfig], condition: str, training: bool = False) -> Side:
    names = [arm.name for arm in arms]
    wanted = (condition, "training") if training else (condition,)
    rows = [row for row in summary.per_seed if row["arm"] in names and row["condition"] in wanted]
    totals = {
        key: int(sum(row.get(key, 0) for row in rows))
        for key in ("steps", "infeasible", "fallback", "unsafe")
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


def verdict(experiment: ExperimentConfig, summary: Summary) -> list[str]:
    """Whether the filter kept the limits, what that cost, and how often it stepped in; the main point first.

    An arm without a filter and one with it count with all their training and the evaluation that is theirs
    (filter off, filter on). Where the policies are the same, only their evaluation is compared. Of a single pair
    all returns are told: of either policy without and with the filter.
    """
    pairs, judge = compared_pairs(experiment), judged_by(experiment, summary.judged)
    training = bool(pairs) and pairs[0].bare != pairs[0].filtered
    off = _side(summary, [pair.bare for pair in pairs], "filter_off", training)
    on = _side(summary, [pair.filtered for pair in pairs], "filter_on", training)
    if not off.steps or not on.steps:
        return [part for part in ("There is no filter to compare with yet.", judge) if part]
    if off.violations is None or on.violations is None:
        outside = f"{on.unsafe:,} of {on.steps:,} steps" if on.unsafe else f"none of {on.steps:,} steps"
        first = [judge, f"By the filter's own measure {outside} with it began outside the safe set."]
    else:
        first = [_safety(off, on), judge]
    returns = _returns(pairs[0], summary) if len(pairs) == 1 else []
    return [part for part in (*first, *returns, _work(on)) if part]


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


def _returns(pair: Pair, summary: Summary) -> list[str]:
    """What either policy returned in evaluation, without and with the filter; which did better with it on."""
    told, acting = [], []
    for arm in dict.fromkeys(arm.name for arm in pair):
        who = "Trained through the filter" if arm == pair.filtered.name else "Trained without the filter"
        who = "The policy" if pair.bare == pair.filtered else who
        for condition in ("filter_off", "filter_on"):
            side = _side(summary, [each for each in pair if each.name == arm][:1], condition)
            if not (side.returns and side.steps):
                continue
            told.append(f"{who}, {condition.replace('_', ' ')} {side.returns[0]}")
            if side.violations is not None:
                told[-1] += f" with {side.violations:,} of {side.steps:,} steps in violation"
            acting += side.returns if condition == "filter_on" else []
    said = [f"Return per evaluation episode: {'; '.join(told)}."] if told else []
    return [*said, _choice(*acting)] if len(acting) == 2 else said


def _choice(added: Estimate, through: Estimate) -> str:
    """Whether it paid to train through the filter that is on afterwards."""
    if added.iqm == through.iqm:
        return "With the filter on, both returned the same."
    better = "trained without it" if added.iqm > through.iqm else "trained through it"
    seeds = min(added.seeds, through.seeds)
    surely = "one seed says little" if seeds < 2 else f"{seeds} seeds say little"
    if seeds >= SEEDS_FOR_AN_INTERVAL:
        apart = max(added.low or 0.0, through.low or 0.0) > min(added.high or 0.0, through.high or 0.0)
        surely = f"the intervals over {seeds} seeds {'lie apart' if apart else 'overlap'}"
    return f"With the filter on, the policy {better} returned more ({surely})."


def _work(on: Side) -> str:
    """What the filter did: in evaluation, and, where it was on in training, how often it failed in both."""
    changed = percent(on.changed) if on.changed else "none"
    said = "" if on.changed is None else f"The filter changed {changed} of the evaluation steps. "
    were = "step was" if on.infeasible == 1 else "steps were"
    failed = f"{on.infeasible:,} {were} infeasible and {on.fallback:,} ran the fallback"
    return f"{said}Of {on.steps:,} steps with it {failed}."
