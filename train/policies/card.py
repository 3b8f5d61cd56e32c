"""The model card of a policy: what it is, and what was measured of its safety."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from safe_wrappers.errors import RunStateError

from ..atomic import write_text
from ..checksums import read_facts
from ..config import ArmConfig, FilterConfig
from ..evaluation.evaluate import check_evaluation, conditions
from ..evaluation.metrics import METRICS, NOT_JUDGED, OF_THE_JUDGE
from ..evaluation.summary import CONDITIONS, episode_file, number, seed_row
from ..run.portable import CONFIG, FILTER, POLICY
from ..tables import read_rows

CARD: Final = "README.md"
_FIGURES: Final = (
    "return",
    "cost",
    "violations",
    "intervention_rate",
    "correction_mean",
    "infeasible",
    "fallback",
)


def write_card(arm: ArmConfig, seed: int, run: Path, default_filter: FilterConfig) -> None:
    """Writes the card of a run's policy, with what is measured by now; does nothing if the run left no policy.

    Args:
        arm: The run's arm.
        seed: Its seed.
        run: Its folder.
        default_filter: The filter of the evaluation, of an arm that has none.
    """
    folder = run / POLICY
    if not (folder / CONFIG).is_file():
        return
    again = "`safe-wrappers train` writes it again"
    config = read_facts(folder / CONFIG, again)
    constraints = read_facts(folder / FILTER, again)["constraints"]
    used = conditions(arm, default_filter).get("filter_on", FilterConfig())
    own = f"through the filter `{arm.filter.kind}`" if arm.filter.kind != "none" else "without a filter"
    lines = [
        "---",
        "library_name: stable-baselines3",
        f"tags: [{json.dumps(arm.env.id)}, reinforcement-learning, deep-reinforcement-learning, safe-wrappers]",
        "---",
        "",
        f"# {arm.algorithm} on {_text(arm.env.id)}",
        "",
        f"Arm {_code(arm.name)}, seed {seed}: trained for {config['timesteps']:,} steps {own}"
        f" (learner `{arm.learner.kind}`).",
        "",
        "## Safety figures",
        "",
        *_table(run),
        "",
        f"Evaluation is deterministic; its filter is `{used.kind}`. {_judge(arm)}",
        "Figures of one seed say nothing about another one.",
        "",
        "## The filter that it was trained with",
        "",
        *([f"* {_code(constraint)}" for constraint in constraints] or ["None."]),
        "",
        "A policy that was trained through a filter is no safer without it. Loading refuses another env or filter,"
        " unless told.",
        "",
        "## Use",
        "",
        "```python",
        "from safe_wrappers.train.policies import load_policy",
        "",
        'trained = load_policy("this folder")',
        "env = trained.make_env()  # the filter is on",
        "```",
        "",
        "Weights and statistics are arrays, all else is JSON: nothing is unpickled. Made with"
        f" {_text(', '.join(f'{name} {number}' for name, number in config['versions'].items()))}.",
    ]
    write_text(folder / CARD, "\n".join(lines) + "\n")


def _table(run: Path) -> list[str]:
    try:
        check_evaluation(run)
        measured_in = tuple(CONDITIONS)
    except RunStateError:  # it will be made again
        measured_in = ("training",)
    rows = {name: read_rows(episode_file(run, name)) for name in measured_in}
    measured = {name: seed_row(episodes, _FIGURES) for name, episodes in rows.items() if episodes}
    if not measured:
        return ["Nothing was measured yet."]
    head = ["", *(CONDITIONS[name] for name in measured)]
    body = [["Episodes; steps", *(f"{row['episodes']}; {row['steps']:,}" for row in measured.values())]]
    body += [[METRICS[key], *(_cell(row, key) for row in measured.values())] for key in _FIGURES]
    lines = [head, ["---"] * len(head), *body]
    return ["| " + " | ".join(cells) + " |" for cells in lines]


def _cell(row: Mapping[str, Any], key: str) -> str:
    if key in row:
        return number(float(row[key]))
    return NOT_JUDGED if key in OF_THE_JUDGE else "-"


def _text(value: object) -> str:
    """In one line, and no markup."""
    return html.escape(_line(value), quote=False)


def _code(value: object) -> str:
    """In one line, as it is but for what would end the code."""
    return f"`{_line(value)}`"


def _line(value: object) -> str:
    return " ".join(str(value).split()).replace("`", "'")


def _judge(arm: ArmConfig) -> str:
    if arm.env.cost is not None:
        return f"Violations are judged by {_code(arm.env.cost)}."
    if arm.env.judge is not None:
        return "Violations are judged by the filter's own limits."
    return "Violations are the task's own, where it reports a cost."
