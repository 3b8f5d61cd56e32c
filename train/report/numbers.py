"""The tables: the short one of the headline, and all that was measured."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from datetime import timedelta
from typing import Any, Final

from ..config import ArmConfig, ExperimentConfig
from ..evaluation.metrics import METRICS, NOT_JUDGED, OF_THE_JUDGE
from ..evaluation.summary import CONDITIONS, Estimate, Summary, number
from ..run.folder import finished_facts
from .markup import explained, table, text

SHORT: Final = {
    "return": "Return / episode",
    "cost": "Cost / episode",
    "violations": "Steps in violation",
    "intervention_rate": "Steps changed",
    "infeasible": "Infeasible",
    "fallback": "Fallback",
}
"""The short table's numbers and their headings."""
_FACTS: Final = ("elapsed_s", "steps_per_s", "filter_time_us")
"""What a finished run says of itself."""
RUN_NUMBERS: Final = (
    *("arm", "seed", "steps", "episodes", "return", "cost", "violations", "intervention_rate", "infeasible"),
    *_FACTS,
)
"""The columns of the runs' table."""


def short_table(blocks: Iterable[tuple[str, ExperimentConfig, Summary]]) -> str:
    """A row per arm and condition: what was bought, what was paid, how often the filter stepped in.

    Args:
        blocks: (HTML heading or nothing, experiment, its numbers), one under the other.
    """
    head = "".join(f'<th scope="col">{explained(name, label)}</th>' for name, label in SHORT.items())
    body = "".join(_short_rows(*block) for block in blocks)
    return (
        f'<div class="wide"><table class="short"><thead><tr><th></th>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def full_table(experiment: ExperimentConfig, summary: Summary) -> str:
    """Every metric, arms side by side, a part per condition."""
    heads = "".join(f'<th scope="col">{text(arm.name)}</th>' for arm in experiment.arms)
    body = []
    for condition, title in CONDITIONS.items():
        cells = [summary.table[arm.name][condition] for arm in experiment.arms]
        if not any(cells):
            continue
        body.append(
            f'<tr class="condition"><th scope="rowgroup" colspan="{len(cells) + 1}">{text(title)}</th></tr>'
        )
        for metric in METRICS:
            if metric in ("cost", "violations") or any(metric in cell for cell in cells):
                values = "".join(f"<td>{_cell(cell, metric)}</td>" for cell in cells)
                body.append(f'<tr><th scope="row">{explained(metric)}</th>{values}</tr>')
    return (
        f'<div class="wide"><table><thead><tr><th></th>{heads}</tr></thead>'
        f"<tbody>{''.join(body)}</tbody></table></div>"
    )


def seeds_table(summary: Summary) -> str:
    """Every seed under every condition."""
    columns = seeds_columns(summary)
    rows = [[row.get(column, "") for column in columns] for row in summary.per_seed]
    return table(columns, rows, (explained(column, column) for column in columns))


def seeds_columns(summary: Summary) -> list[str]:
    """The columns of the seeds' table, which are those of `per_seed.csv` that hold something."""
    columns = ["arm", "seed", "condition", "episodes", "steps", *METRICS]
    return [column for column in columns if any(column in row for row in summary.per_seed)]


def runs_table(experiment: ExperimentConfig, summary: Summary) -> str:
    """What each run's training came to in all, and how long it took."""
    trained = {(row["arm"], row["seed"]): row for row in summary.per_seed if row["condition"] == "training"}
    body = []
    for arm in experiment.arms:
        for seed in experiment.seeds:
            row = trained.get((arm.name, seed), {}) | _facts(experiment, arm, seed)
            cells = "".join(f"<td>{_run_cell(row, name)}</td>" for name in RUN_NUMBERS[2:])
            body.append(f'<tr><th scope="row">{text(arm.name)}</th><td>{seed}</td>{cells}</tr>')
    head = "".join(f'<th scope="col">{explained(name, SHORT.get(name, ""))}</th>' for name in RUN_NUMBERS)
    return (
        f'<div class="wide"><table class="short runs"><thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(body)}</tbody></table></div>"
    )


def _facts(experiment: ExperimentConfig, arm: ArmConfig, seed: int) -> dict[str, float]:
    facts = finished_facts(experiment.run_folder(arm, seed))
    return {name: facts[name] for name in _FACTS if facts.get(name) is not None}


def _run_cell(row: Mapping[str, Any], name: str) -> str:
    if name not in row:
        return NOT_JUDGED if "episodes" in row and name in OF_THE_JUDGE else "-"
    if name == "elapsed_s":
        return str(timedelta(seconds=round(row[name])))
    if name == "intervention_rate":
        return f"{100 * row[name]:.3g} %"
    if name == "violations":
        return f'<b class="{"bad" if row[name] else "good"}">{row[name]:,.0f}</b>'
    return text(number(row[name]))


def _short_rows(heading: str, experiment: ExperimentConfig, summary: Summary) -> str:
    rows = [
        f'<tr class="experiment"><th scope="rowgroup" colspan="{len(SHORT) + 1}">{heading}</th></tr>'
    ] * bool(heading)
    for arm in experiment.arms:
        if not any(summary.table[arm.name].values()):
            continue
        rows.append(
            f'<tr class="arm"><th scope="rowgroup" colspan="{len(SHORT) + 1}">{text(arm.name)}'
            f" <small>{text(_trained(arm))}</small></th></tr>"
        )
        rows += [
            _short_row(title, summary, arm, condition)
            for condition, title in CONDITIONS.items()
            if summary.table[arm.name][condition]
        ]
    return "".join(rows)


def _trained(arm: ArmConfig) -> str:
    if arm.filter.kind == "none":
        return "trained without a filter"
    learner = "" if arm.learner.kind == "naive" else f", learner {arm.learner.kind}"
    return f"trained through the filter{learner}"


def _short_row(title: str, summary: Summary, arm: ArmConfig, condition: str) -> str:
    cell = summary.table[arm.name][condition]
    rows = [row for row in summary.per_seed if (row["arm"], row["condition"]) == (arm.name, condition)]
    steps = sum(row["steps"] for row in rows)

    def total(key: str) -> str:
        return f"{int(sum(row[key] for row in rows)):,}" if all(key in row for row in rows) else "-"

    changed = cell.get("intervention_rate")
    mood = "good" if total("violations") == "0" else "bad"
    values = [
        _cell(cell, "return"),
        _cell(cell, "cost"),
        f'<b class="{mood}">{total("violations")}</b> <small>of {steps:,}</small>'
        if "violations" in cell
        else NOT_JUDGED,
        "-" if changed is None else f"<b>{100 * changed.iqm:.3g} %</b>",
        *("-" if changed is None else f"<b>{total(key)}</b>" for key in ("infeasible", "fallback")),
    ]
    return (
        f'<tr><th scope="row">{text(title)}</th>' + "".join(f"<td>{value}</td>" for value in values) + "</tr>"
    )


def _cell(cell: Mapping[str, Estimate], metric: str) -> str:
    value = cell.get(metric)
    if value is None:
        return NOT_JUDGED if cell and metric in OF_THE_JUDGE else "-"
    if value.low is None or value.high is None:
        return f"<b>{text(number(value.iqm))}</b> <small>[n/a]</small>"
    return f"<b>{text(number(value.iqm))}</b> <small>[{text(number(value.low))}, {text(number(value.high))}]</small>"
