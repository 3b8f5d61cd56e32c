"""The comparison as a table on the terminal."""

from __future__ import annotations

from rich.table import Table

from ..config import ExperimentConfig
from ..evaluation.has_cost import judged_by
from ..evaluation.metrics import METRICS, NOT_JUDGED, OF_THE_JUDGE
from ..evaluation.summary import CONDITIONS, Estimate, Summary, over_seeds

_ALWAYS = ("cost", "violations")
"""A reader looks for these, and is told if they are not judged."""


def comparison_table(experiment: ExperimentConfig, summary: Summary) -> Table:
    """Arms side by side, a section per condition; a mean over seeds, and its range or interval."""
    brackets = over_seeds(*summary.seeds).replace("[", r"\[")  # no markup
    table = Table(
        title=f"{experiment.name}: {brackets}", caption=judged_by(experiment, summary.judged) or None
    )
    table.add_column("")
    for arm in experiment.arms:
        table.add_column(arm.name, justify="right")
    for condition, title in CONDITIONS.items():
        cells = [summary.table[arm.name][condition] for arm in experiment.arms]
        if not any(cells):
            continue
        table.add_section()
        table.add_row(f"[bold]{title}[/bold]")
        for metric in METRICS:
            if metric in _ALWAYS or any(metric in cell for cell in cells):
                values = [_value(metric, cell) for cell in cells]
                table.add_row(f"  {METRICS[metric]}", *values)
    return table


def _value(metric: str, cell: dict[str, Estimate]) -> str:
    if metric in cell:
        return str(cell[metric]).replace("[", r"\[")
    return NOT_JUDGED if cell and metric in OF_THE_JUDGE else "-"
