"""The numbers as rows: for the page, and as a table on the terminal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import timedelta
from typing import Any, Final, NamedTuple

from rich.markup import escape
from rich.table import Table

from ..config import ArmConfig, ExperimentConfig
from ..evaluation.metrics import METRICS, NOT_JUDGED, OF_THE_JUDGE
from ..evaluation.summary import CONDITIONS, Estimate, Summary, judged_by, number, over_seeds
from ..run.folder import finished_facts

SHORT: Final = {
    "return": "Return / episode",
    "cost": "Cost / episode",
    "violations": "Steps in violation",
    "intervention_rate": "Steps changed",
    "infeasible": "Infeasible",
    "fallback": "Fallback",
}
"""The short table's numbers and their headings."""
RUN_COLUMNS: Final = {
    "steps": "Steps", "episodes": "Episodes", **{name: SHORT[name] for name in list(SHORT)[:5]},
    "elapsed_s": "Training time", "steps_per_s": "Steps/s", "filter_time_us": "Filter call in µs",
}  # fmt: skip
"""The numbers of the runs' table and their headings; the last three are what a finished run says of itself."""


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


def run_rows(experiment: ExperimentConfig, summary: Summary) -> Iterator[tuple[str, list[Cell]]]:
    """What each run's training came to in all, and how long it took."""
    trained = {(row["arm"], row["seed"]): row for row in summary.per_seed if row["condition"] == "training"}
    for arm in experiment.arms:
        for seed in experiment.seeds:
            facts = finished_facts(experiment.run_folder(arm, seed))
            row = trained.get((arm.name, seed), {}) | {
                name: facts.get(name) for name in list(RUN_COLUMNS)[-3:]
            }
            yield f"{arm.name}, seed {seed}", [_of_run(row, name) for name in RUN_COLUMNS]


def _of_run(row: Mapping[str, Any], name: str) -> Cell:
    value = row.get(name)
    if value is None:
        return Cell(NOT_JUDGED if "episodes" in row and name in OF_THE_JUDGE else "-")
    if name == "elapsed_s":
        return Cell(str(timedelta(seconds=round(value))))
    if name == "intervention_rate":
        return Cell(f"{100 * value:.3g} %")
    return Cell(number(value), mood=("bad" if value else "good") if name == "violations" else "")


def _estimate(cell: Mapping[str, Estimate], metric: str) -> Cell:
    value = cell.get(metric)
    if value is None:
        return Cell(NOT_JUDGED if cell and metric in OF_THE_JUDGE else "-")
    whole = str(value)
    return Cell(number(value.iqm), whole[whole.index("[") :])
