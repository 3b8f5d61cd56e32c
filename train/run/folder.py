"""A run's folder: whose it is, and whether the run is finished."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from safe_wrappers.errors import ConfigurationError, RunStateError

from ..config.models import ArmConfig, stored_arm
from ..files import read_json, write_json

RUN_FILE: Final = "run.json"
FINISHED_FILE: Final = "finished.json"
CHECKPOINTS: Final = "checkpoints"
EVALUATION: Final = "evaluation"
POLICY: Final = "policy"
EPISODES: Final = "episodes.csv"
TENSORBOARD: Final = "tensorboard"


def is_finished(arm: ArmConfig, folder: Path) -> bool:
    """Whether the run has made its steps."""
    return int(read_json(folder / FINISHED_FILE).get("timesteps", -1)) >= arm.total_steps


def check_finished(arm: ArmConfig, folder: Path) -> None:
    """Refuses a run that is not trained to its end."""
    if not is_finished(arm, folder):
        raise RunStateError(
            f"The run in {str(folder)!r} is not trained to its end; run `safe-wrappers train` (or `compare`)."
        )


def stored_run(folder: Path) -> ArmConfig:
    """The arm of a run, as its folder has it.

    Raises:
        RunStateError: There is no run, or it does not say what it is of.
    """
    path = folder / RUN_FILE
    try:
        stored = read_json(path)
        return stored_arm(stored["arm"], stored["config"])
    except (KeyError, TypeError, ConfigurationError) as error:
        raise RunStateError(f"{str(path)!r} does not say what the run is of: {error!r}") from error


def check_folder(arm: ArmConfig, seed: int, folder: Path) -> None:
    """Refuses a folder that belongs to another config; `total_steps` may be more than what it was begun with.

    Before its first checkpoint a run has nothing that could be lost, and another may take its folder: a setting that
    is found to be wrong by the first update does not stand against the corrected command.
    """
    if not _is_begun(folder):
        return
    theirs = stored_run(folder)
    there = _flat({"seed": read_json(folder / RUN_FILE).get("seed"), **theirs.fingerprint()})
    here = _flat(json.loads(json.dumps({"seed": seed, **arm.fingerprint()})))
    differ = {key for key in there.keys() | here.keys() if there.get(key, "unset") != here.get(key, "unset")}
    if theirs.total_steps <= arm.total_steps:
        differ.discard("total_steps")
    if differ:
        lines = [
            f"  {key}: {there.get(key, 'unset')!r} in the folder, {here.get(key, 'unset')!r} in the config"
            + " (it can be raised, not lowered)" * (key == "total_steps")
            for key in sorted(differ)
        ]
        raise RunStateError(
            f"The run folder {str(folder)!r} belongs to another config:\n" + "\n".join(lines) + "\n"
            "Choose another `name` or `output`, go back to its settings, or delete the folder."
        )


def claim_folder(arm: ArmConfig, seed: int, folder: Path) -> None:
    """Marks a folder that `check_folder` let through as this run's, or as one whose total was raised."""
    if not _is_begun(folder):  # of another config, which came to nothing
        shutil.rmtree(folder / TENSORBOARD, ignore_errors=True)
        (folder / EPISODES).unlink(missing_ok=True)
    ours = {"arm": arm.name, "seed": seed, "config": arm.fingerprint()}
    if not _is_begun(folder) or read_json(folder / RUN_FILE) != ours:
        write_json(folder / RUN_FILE, ours)


def _is_begun(folder: Path) -> bool:
    return (folder / FINISHED_FILE).exists() or any((folder / CHECKPOINTS).glob("step_*"))


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat
