"""One self-contained HTML page: what the filter bought and what it cost, to be understood in a minute."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import yaml

from safe_wrappers.errors import RunStateError

from .atomic import write_text
from .config import ArmConfig, ExperimentConfig
from .curves import learning_curve
from .evaluate import evaluation_folder
from .figures import curves_svg, legend, scenes_svg
from .report_style import STYLE
from .run import FINISHED_FILE
from .scene import Scene, load_scenes
from .summary import CONDITIONS, METRICS, OF_THE_FILTER, Estimate, Summary, number

_CURVES = {
    "return": "Return per episode",
    "cost": "Cost per episode",
    "intervention_rate": "Share of steps changed by the filter",
    "correction_mean": "Correction per step (L2, action units)",
}


def write_report(experiment: ExperimentConfig, summary: Summary) -> Path:
    """Writes the experiment's `report.html`.

    Args:
        experiment: The experiment; what its folder holds is shown, nothing is trained.
        summary: Its numbers.

    Returns:
        Where the page is.

    Raises:
        RunStateError: There is nothing to report yet.
    """
    if not summary.per_seed:
        raise RunStateError(
            f"Nothing to report in {str(experiment.folder)!r} yet; run `safe-wrappers compare` first."
        )
    path = experiment.folder / "report.html"
    write_text(path, _page(experiment, summary))
    return path


def _page(experiment: ExperimentConfig, summary: Summary) -> str:
    arm = experiment.arms[0]
    seeds = len(experiment.seeds)
    about = (
        f"{arm.algorithm} on {arm.env.id}, {arm.total_steps:,} steps, {seeds} seed{'s' * (seeds > 1)}; "
        f"evaluation on {experiment.evaluation.episodes} episodes, the same ones for every arm and seed."
    )
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<link rel="icon" href="data:,">
<title>{_text(experiment.name)}: filtered and unfiltered</title>
<style>{STYLE}</style>
</head>
<body>
<main>
<header><h1>{_text(experiment.name)}</h1><p>{_text(about)}</p></header>
{_headline(experiment, summary)}
<section><h2>The same episode, without and with the filter</h2>{_trajectories(experiment)}</section>
<section><h2>While training</h2>{_curves(experiment)}</section>
<section><h2>All numbers</h2>{_table(experiment, summary)}</section>
<section><h2>How to read this</h2>{_notes(experiment)}</section>
<section><details><summary>Every seed</summary>{_seeds(summary)}</details>
<details><summary>Runs</summary>{_runs(experiment)}</details>
<details><summary>Settings</summary><pre>{_text(_settings(experiment))}</pre></details></section>
</main>
</body>
</html>
"""


def _headline(experiment: ExperimentConfig, summary: Summary) -> str:
    bare, filtered = _pair(experiment)
    if bare is None or filtered is None:
        return ""

    def cell(arm: ArmConfig, condition: str, metric: str) -> Estimate | None:
        return summary.table[arm.name][condition].get(metric)

    def total(arm: ArmConfig, key: str, condition: str = "training") -> int:
        rows = (row for row in summary.per_seed if (row["arm"], row["condition"]) == (arm.name, condition))
        return int(sum(row[key] for row in rows))

    cards = [
        _card(
            "Steps with a violation while training",
            f"{total(filtered, 'violations'):,}",
            f"in {total(filtered, 'steps'):,} steps with the filter",
            f"{total(bare, 'violations'):,} in {total(bare, 'steps'):,} without",
        )
    ]
    for metric in ("cost", "return"):
        with_filter = cell(filtered, "filter_on", metric)
        without = cell(bare, "filter_off", metric)
        if with_filter and without:
            cards.append(
                _card(
                    f"{metric.capitalize()} per evaluation episode",
                    number(with_filter.iqm),
                    "trained and run with the filter",
                    f"{number(without.iqm)} without",
                )
            )
    changed = cell(filtered, "filter_on", "intervention_rate")
    if changed:
        infeasible, fallback = (
            total(filtered, key) + total(filtered, key, "filter_on") for key in ("infeasible", "fallback")
        )
        cards.append(
            _card(
                "Steps changed by the filter",
                f"{100 * changed.iqm:.1f} %",
                "of evaluation steps",
                f"{infeasible:,} infeasible, {fallback:,} fallback steps, training included",
            )
        )
    return f'<section class="cards">{"".join(cards)}</section>'


def _card(title: str, value: str, what: str, other: str) -> str:
    return (
        f'<div class="card"><h3>{_text(title)}</h3><p class="value">{_text(value)}</p>'
        f'<p>{_text(what)}</p><p class="other">{_text(other)}</p></div>'
    )


def _trajectories(experiment: ExperimentConfig) -> str:
    bare, filtered = _pair(experiment)
    left_arm, right_arm = bare or filtered, filtered or bare
    assert left_arm is not None and right_arm is not None
    seed = experiment.seeds[0]
    left = _scenes(experiment, left_arm, "filter_off")
    right = _scenes(experiment, right_arm, "filter_on")
    common = left.keys() & right.keys()
    if not common:
        return (
            "<p>No picture: it needs an evaluation with and without a filter, of a task that publishes"
            " <code>agent_position</code>.</p>"
        )
    # The unfiltered arm's worst case, and the text says so: an arbitrary episode may show nothing at all.
    episode = max(sorted(common), key=lambda key: int(left[key].violated.sum()))
    names = [arm.name for arm in experiment.arms]
    svg = scenes_svg(
        [
            (_scene_title(left_arm.name, left[episode]), names.index(left_arm.name), left[episode]),
            (_scene_title(right_arm.name, right[episode]), names.index(right_arm.name), right[episode]),
        ]
    )
    keys = legend(
        {
            "path without": f"arm{names.index(left_arm.name)}",
            "path with": f"arm{names.index(right_arm.name)}",
            "filter changed the action": "mark",
            "violation": "bad",
            "hazard": "hazard",
            "goals, in order": "goal",
            "vase": "vase",
        }
    )
    return (
        f'<figure>{svg}<figcaption class="keys">{keys}</figcaption></figure>'
        f"<p>Episode seed {episode}: of the {len(common)} evaluation episodes the one in which"
        f" {_text(left_arm.name)} had most violations. Policies of training seed {seed}; the circle is the"
        " start.</p>"
    )


def _scene_title(arm: str, scene: Scene) -> str:
    return f"{arm}: {int(scene.violated.sum())} violations, {int(scene.intervened.sum())} steps changed"


def _scenes(experiment: ExperimentConfig, arm: ArmConfig, condition: str) -> dict[int, Scene]:
    folder = evaluation_folder(experiment.run_folder(arm, experiment.seeds[0]))
    return load_scenes(folder / f"{condition}.npz")


def _curves(experiment: ExperimentConfig) -> str:
    panels = {
        title: {
            arm.name: learning_curve(experiment, arm, metric)
            for arm in experiment.arms
            if arm.filter.kind != "none" or metric not in OF_THE_FILTER
        }
        for metric, title in _CURVES.items()
    }
    names = [arm.name for arm in experiment.arms]
    keys = legend({_text(name): f"arm{index % 6}" for index, name in enumerate(names)})
    band = "The band is the bootstrap 95 % interval over seeds." if len(experiment.seeds) > 1 else ""
    picture = curves_svg(panels, names)
    return f'<figure><figcaption class="keys">{keys}</figcaption>{picture}</figure><p>{band}</p>'


def _table(experiment: ExperimentConfig, summary: Summary) -> str:
    heads = "".join(f"<th>{_text(arm.name)}</th>" for arm in experiment.arms)
    body = []
    for condition, title in CONDITIONS.items():
        cells = [summary.table[arm.name][condition] for arm in experiment.arms]
        if not any(cells):
            continue
        body.append(f'<tr class="condition"><th colspan="{len(cells) + 1}">{_text(title)}</th></tr>')
        for metric in METRICS:
            if any(metric in cell for cell in cells):
                values = "".join(f"<td>{_cell(cell.get(metric))}</td>" for cell in cells)
                body.append(f"<tr><th>{_text(METRICS[metric])}</th>{values}</tr>")
    return (
        f'<div class="wide"><table><thead><tr><th></th>{heads}</tr></thead>'
        f"<tbody>{''.join(body)}</tbody></table></div>"
    )


def _cell(value: Estimate | None) -> str:
    if value is None:
        return "-"
    mean, interval = str(value).split(" ", 1)
    return f"<b>{mean}</b> <small>{interval}</small>"


def _notes(experiment: ExperimentConfig) -> str:
    used = experiment.evaluation_filter
    notes = [
        "Numbers are interquartile means over seeds (the middle half; with fewer than four the plain mean),"
        " brackets are percentile-bootstrap 95 % intervals over seeds. With a handful of seeds they are too"
        " narrow; with one there is none.",
        "A violation is a control step in which the task's own truth reports a cost, at its end or at any"
        " physics substep. The filter's own opinion does not count.",
        "Evaluation is deterministic and paired: episode i starts from the same env seed in every row.",
        "The policies learn from the action that they proposed, not from the executed one (“naive” in"
        " Krasowski et al., TMLR 2023).",
    ]
    if used.kind != "none":
        notes.append(
            "“Filter on” puts an arm's own filter on; an arm that has none gets the first filtered arm's."
        )
    return "<ul>" + "".join(f"<li>{_text(note)}</li>" for note in notes) + "</ul>"


def _seeds(summary: Summary) -> str:
    columns = ["arm", "seed", "condition", "episodes", "steps", *METRICS]
    columns = [column for column in columns if any(column in row for row in summary.per_seed)]
    return _rows(columns, [[row.get(column, "") for column in columns] for row in summary.per_seed])


def _runs(experiment: ExperimentConfig) -> str:
    rows = []
    for arm in experiment.arms:
        for seed in experiment.seeds:
            path = experiment.run_folder(arm, seed) / FINISHED_FILE
            facts = json.loads(path.read_text()) if path.exists() else {}
            values = [facts.get(key) for key in ("timesteps", "steps_per_s", "elapsed_s", "filter_time_us")]
            rows.append([arm.name, seed, *("-" if value is None else value for value in values)])
    return _rows(["arm", "seed", "steps", "steps/s", "seconds", "one filter call in µs"], rows)


def _rows(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    head = "".join(f"<th>{_text(column)}</th>" for column in columns)
    body = "".join(
        "<tr>"
        + "".join(f"<td>{_text(number(v) if isinstance(v, float) else str(v))}</td>" for v in row)
        + "</tr>"
        for row in rows
    )
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _settings(experiment: ExperimentConfig) -> str:
    values = asdict(experiment)
    values |= {
        "output": str(experiment.output),
        "arms": list(values["arms"]),
        "seeds": list(experiment.seeds),
    }
    return yaml.safe_dump(values, sort_keys=False)


def _pair(experiment: ExperimentConfig) -> tuple[ArmConfig | None, ArmConfig | None]:
    bare = next((arm for arm in experiment.arms if arm.filter.kind == "none"), None)
    filtered = next((arm for arm in experiment.arms if arm.filter.kind != "none"), None)
    return bare, filtered


def _text(value: str) -> str:
    return html.escape(value)
