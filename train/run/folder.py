"""A run's folder: whose it is, and whether the run is finished."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from safe_wrappers.errors import RunStateError

from ..atomic import json_bytes, write_json
from ..checksums import read_facts
from ..config import ArmConfig
from .start import START_FILE
from .trackers import IDS_FILE, TENSORBOARD

RUN_FILE: Final = "run.json"
FINISHED_FILE: Final = "finished.json"
CHECKPOINTS: Final = "checkpoints"
EVALUATION: Final = "evaluation"
EPISODES: Final = "episodes.csv"


def finished_facts(folder: Path) -> dict[str, Any]:
    """What a run noted when it was finished: `timesteps`, times, and checksums of `files`; empty before that.

    Raises:
        RunStateError: The note is unreadable.
    """
    return read_facts(folder / FINISHED_FILE, "`safe-wrappers train` (or `compare`) writes it again.")


def is_finished(arm: ArmConfig, folder: Path) -> bool:
    """Whether the run has made its steps; one whose note of it is damaged has to find out."""
    try:
        return int(finished_facts(folder).get("timesteps", -1)) >= arm.total_steps
    except RunStateError:
        return False


def check_finished(arm: ArmConfig, folder: Path) -> None:
    """Refuses a run that is not trained to its end.

    Raises:
        RunStateError: It is not.
    """
    if not is_finished(arm, folder):
        finished_facts(folder)
        raise RunStateError(
            f"The run in {str(folder)!r} is not trained to its end; run `safe-wrappers train` (or `compare`)."
        )


def is_outgrown(arm: ArmConfig, folder: Path) -> bool:
    """Whether the run was finished with fewer steps than it should have now: what shows its policy is out of date."""
    try:
        return int(finished_facts(folder).get("timesteps", arm.total_steps)) < arm.total_steps
    except RunStateError:  # nobody knows of how many; its evaluation does
        return False


def check_folder(arm: ArmConfig, seed: int, folder: Path) -> None:
    """Refuses a folder that belongs to another config; `total_steps` may be more than what it was begun with.

    Before its first checkpoint a run has nothing that could be lost, and another may take its folder: a setting that
    is found to be wrong by the first update does not stand against the corrected command.

    Raises:
        RunStateError: Another config's; shows the settings that differ.
    """
    path = folder / RUN_FILE
    if not _is_begun(folder):
        return
    if not path.exists():
        raise RunStateError(
            f"{str(folder)!r} has checkpoints but no {RUN_FILE} that says what they are of; delete it, or"
            " choose another `name` or `output`."
        )
    try:
        theirs = json.loads(path.read_text())
        there, here = _flat(theirs), _flat(json.loads(json.dumps(_identity(arm, seed))))
    except (ValueError, AttributeError):
        raise RunStateError(f"{str(path)!r} is unreadable; delete {str(folder)!r} to train again.") from None
    differ = {key for key in there.keys() | here.keys() if there.get(key, "unset") != here.get(key, "unset")}
    if there.get("total_steps", 0) <= arm.total_steps:
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
    path, ours = folder / RUN_FILE, _identity(arm, seed)
    if _is_begun(folder):
        if json.loads(path.read_text())["config"].get("total_steps") == arm.total_steps:
            return
    elif path.exists() and path.read_bytes() != json_bytes(ours):
        shutil.rmtree(folder / TENSORBOARD, ignore_errors=True)  # of another config, which came to nothing
        for name in (EPISODES, START_FILE, IDS_FILE):
            (folder / name).unlink(missing_ok=True)
    write_json(path, ours)


def _is_begun(folder: Path) -> bool:
    return (folder / FINISHED_FILE).exists() or any((folder / CHECKPOINTS).glob("step_*"))


def _identity(arm: ArmConfig, seed: int) -> dict[str, Any]:
    return {"arm": arm.name, "seed": seed, "config": arm.fingerprint()}


def _flat(value: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, item in value.items():
        name = key if not prefix and key != "config" else f"{prefix}.{key}".lstrip(".")
        if isinstance(item, dict) and item:
            flat.update(_flat(item, "" if name == "config" else name))
        else:
            flat[name] = item
    return flat
