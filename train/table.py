"""The comparison as a table on the terminal."""

from __future__ import annotations

from rich.table import Table

from .config import ExperimentConfig
from .summary import CONDITIONS, METRICS, Summary


def comparison_table(experiment: ExperimentConfig, summary: Summary) -> Table:
    """Arms side by side, a section per condition; interquartile mean and 95 % interval over seeds."""
    seeds = len(experiment.seeds)
    table = Table(
        title=f"{experiment.name}: interquartile mean over {seeds} seed{'s' * (seeds > 1)}"
        r" \[bootstrap 95 % interval]"
    )
    table.add_column("")
    for arm in experiment.arms:
        table.add_column(arm.name, justify="right")
    for condition, title in CONDITIONS.items():
        cells = [summary.table[arm.name][condition] for arm in experiment.arms]
        shown = [metric for metric in METRICS if any(metric in cell for cell in cells)]
        if shown:
            table.add_section()
            table.add_row(f"[bold]{title}[/bold]")
        for metric in shown:
            # Brackets of an interval are no markup.
            values = [str(cell[metric]).replace("[", r"\[") if metric in cell else "-" for cell in cells]
            table.add_row(f"  {METRICS[metric]}", *values)
    return table
