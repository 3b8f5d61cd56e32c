"""The numbers as rows: for the page, and as a table on the terminal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final, NamedTuple

from rich.markup import escape
from rich.table import Table

from ..config import ArmConfig, ExperimentConfig
from ..evaluation.metrics import METRICS, NOT_JUDGED, OF_THE_JUDGE
from ..evaluation.summary import CONDITIONS, Estimate, Summary, judged_by, number, over_seeds

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
        rows = [row for row in summary.per_seed if (row["arm"], row["condition"]) == (arm.name, condition)]
        total = {key: int(sum(row.get(key, 0) for row in rows)) for key in ("steps", *SHORT)}
        violations, changed = Cell(NOT_JUDGED), [Cell("-")] * 3
        if "violations" in cell:
            mood = "bad" if total["violations"] else "good"
            violations = Cell(f"{total['violations']:,}", f"of {total['steps']:,}", mood)
        if "intervention_rate" in cell:
            share = Cell(f"{100 * cell['intervention_rate'].iqm:.3g} %")
            changed = [share, Cell(f"{total['infeasible']:,}"), Cell(f"{total['fallback']:,}")]
        yield title, [_estimate(cell, "return"), _estimate(cell, "cost"), violations, *changed]


def _estimate(cell: Mapping[str, Estimate], metric: str) -> Cell:
    value = cell.get(metric)
    if value is None:
        return Cell(NOT_JUDGED if cell and metric in OF_THE_JUDGE else "-")
    whole = str(value)
    return Cell(number(value.iqm), whole[whole.index("[") :])
