"""What the trials of a sweep came to: the best first on the terminal, all of them in `sweep.csv`."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rich.table import Table

from ..evaluation.metrics import METRICS
from ..evaluation.summary import number
from ..tables import write_rows
from .study import VIOLATIONS, is_kept

if TYPE_CHECKING:
    import optuna

RESULTS_FILE: Final = "sweep.csv"
_STATES: Final = {"COMPLETE": "", "PRUNED": "pruned", "FAIL": "failed", "RUNNING": "not finished"}
_SHOWN: Final = 10


def ranked(study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    """All trials, the best first.

    By return those in whose evaluation nothing was violated; then the others that were evaluated, by their
    violations; then the rest.
    """

    def place(trial: optuna.trial.FrozenTrial) -> tuple[float, ...]:
        if trial.state.name != "COMPLETE":
            return (2.0, trial.number)
        if is_kept(trial):
            return (0.0, -trial.values[0], trial.number)
        return (1.0, trial.constraints[VIOLATIONS], -trial.values[0], trial.number)

    return sorted(study.get_trials(deepcopy=False), key=place)


def write_results(study: optuna.Study, parameters: Sequence[str], folder: Path) -> Path:
    """Writes `sweep.csv`, a row per trial in their order; what was not evaluated has empty cells."""
    path = folder / RESULTS_FILE
    rows = [
        {"trial": trial.number, "state": _state(trial)}
        | (
            {"return": trial.values[0], VIOLATIONS: trial.constraints[VIOLATIONS]}
            if _evaluated(trial)
            else {}
        )
        | trial.params
        for trial in study.get_trials(deepcopy=False)
    ]
    write_rows(path, ("trial", "state", "return", VIOLATIONS, *parameters), rows)
    return path


def results_table(study: optuna.Study, parameters: Sequence[str], name: str) -> Table:
    """The best trials."""
    trials = ranked(study)
    table = Table(title=f"{name}: the best {min(_SHOWN, len(trials))} of {len(trials)} trials")
    for heading in ("trial", METRICS["return"], METRICS[VIOLATIONS], "", *parameters):
        table.add_column(heading, justify="right")
    for trial in trials[:_SHOWN]:
        came_to = (
            (number(trial.values[0]), number(trial.constraints[VIOLATIONS]))
            if _evaluated(trial)
            else ("-", "-")
        )
        values = map(trial.params.get, parameters)
        told = [number(value) if isinstance(value, float) else str(value) for value in values]
        table.add_row(str(trial.number), *came_to, _state(trial), *told)
    return table


def verdict(study: optuna.Study, parameters: Sequence[str], config: Path, overrides: Sequence[str]) -> str:
    """The best trial and the command that runs the experiment with its values; or that there is none."""
    best = next(iter(ranked(study)), None)
    if best is None or not is_kept(best):
        return "No trial came to an evaluation without violations: none is recommended."
    values = [f"{key}={_yaml(best.params[key])}" for key in parameters]
    command = shlex.join(["safe-wrappers", "compare", str(config), *overrides, *values])
    return f"Best: trial {best.number}, return {number(best.values[0])} at cost zero: {command}"


def _evaluated(trial: optuna.trial.FrozenTrial) -> bool:
    return bool(trial.state.name == "COMPLETE")


def _state(trial: optuna.trial.FrozenTrial) -> str:
    if _evaluated(trial):
        return "at cost zero" if is_kept(trial) else "in violation"
    return _STATES[trial.state.name]


def _yaml(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
