"""Whether what runs left is as they left it: no number is taken from a damaged table."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from safe_wrappers.errors import RunStateError

from ..checksums import damage, read_facts
from ..config import ExperimentConfig
from ..run.folder import finished_facts
from .evaluate import STATE_FILE, evaluation_folder


def check_results(experiment: ExperimentConfig) -> None:
    """Refuses results that are not as they were written.

    Raises:
        RunStateError: They are not; says which file, and what makes it again.
    """
    for arm in experiment.arms:
        for seed in experiment.seeds:
            check_training_table(experiment.run_folder(arm, seed))
            check_evaluation(experiment.run_folder(arm, seed))


def check_training_table(run: Path) -> None:
    """Refuses what a run noted of its training, if it is damaged.

    Raises:
        RunStateError: It is.
    """
    _check(run, finished_facts(run), "`safe-wrappers train` (or `compare`) puts it back.")


def check_evaluation(run: Path) -> None:
    """Refuses a run's evaluation, if it is damaged.

    Raises:
        RunStateError: It is.
    """
    out, remedy = evaluation_folder(run), "`safe-wrappers evaluate` (or `compare`) makes it again."
    _check(out, read_facts(out / STATE_FILE, remedy), remedy)


def _check(folder: Path, facts: dict[str, Any], remedy: str) -> None:
    wrong = damage(folder, facts.get("files", {}))
    if wrong is not None:
        raise RunStateError(f"{wrong}; {remedy}")
