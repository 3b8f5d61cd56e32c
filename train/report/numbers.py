"""The tables: the short one of the headline, and all that was measured."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping

from ..config import ArmConfig, ExperimentConfig
from ..evaluation.summary import CONDITIONS, METRICS, NOT_JUDGED, OF_THE_JUDGE, Estimate, Summary, number
from ..run.training import FINISHED_FILE
from .markup import table, text

_SHORT = (
    "Return / episode",
    "Cost / episode",
    "Steps in violation",
    "Steps changed",
    "Infeasible",
    "Fallback",
)


def short_table(blocks: Iterable[tuple[str, ExperimentConfig, Summary]]) -> str:
    """A row per arm and condition: what was bought, what was paid, how often the filter stepped in.

    Args:
        blocks: (HTML heading or nothing, experiment, its numbers), one under the other.
    """
    head = "".join(f'<th scope="col">{text(column)}</th>' for column in _SHORT)
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
                body.append(f'<tr><th scope="row">{text(METRICS[metric])}</th>{values}</tr>')
    return (
        f'<div class="wide"><table><thead><tr><th></th>{heads}</tr></thead>'
        f"<tbody>{''.join(body)}</tbody></table></div>"
    )


def seeds_table(summary: Summary) -> str:
    """Every seed under every condition."""
    columns = ["arm", "seed", "condition", "episodes", "steps", *METRICS]
    columns = [column for column in columns if any(column in row for row in summary.per_seed)]
    return table(columns, [[row.get(column, "") for column in columns] for row in summary.per_seed])


def runs_table(experiment: ExperimentConfig) -> str:
    """How long each run took."""
    rows = []
    for arm in experiment.arms:
        for seed in experiment.seeds:
            path = experiment.run_folder(arm, seed) / FINISHED_FILE
            facts = json.loads(path.read_text()) if path.exists() else {}
            values = [facts.get(key) for key in ("timesteps", "steps_per_s", "elapsed_s", "filter_time_us")]
            rows.append([arm.name, seed, *("-" if value is None else value for value in values)])
    return table(["arm", "seed", "steps", "steps/s", "seconds", "one filter call in µs"], rows)


def _short_rows(heading: str, experiment: ExperimentConfig, summary: Summary) -> str:
    rows = [
        f'<tr class="experiment"><th scope="rowgroup" colspan="{len(_SHORT) + 1}">{heading}</th></tr>'
    ] * bool(heading)
    for arm in experiment.arms:
        if not any(summary.table[arm.name].values()):
            continue
        rows.append(
            f'<tr class="arm"><th scope="rowgroup" colspan="{len(_SHORT) + 1}">{text(arm.name)}'
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
