"""Policies on the Hugging Face hub, by huggingface_sb3: files there and back."""

from __future__ import annotations

import contextlib
import importlib
import json
from pathlib import Path
from typing import Any, Final

from safe_wrappers.errors import ConfigurationError

from ..run.portable import CONFIG, FILTER, MODEL, NORMALISATION, POLICY, read_policy
from .card import CARD

HUB: Final = "hub:"
"""Before `owner/name` where a folder could stand."""


def upload(folder: Path, repo_id: str, package: Any = None) -> list[str]:
    """Upload a policy's folder, file by file; the model card comes last.

    Args:
        folder: A policy's folder, or that of a run which has one.
        repo_id: `owner/name`; made if it is not there. The hub's own login is used.
        package: huggingface_sb3, if not the installed one.

    Returns:
        The names of the files.

    Raises:
        ConfigurationError: No policy, no `owner/name`, or huggingface_sb3 is not installed.
        RunStateError: A file is not as it was written.
    """
    _check(repo_id)
    folder = folder / POLICY if (folder / POLICY).is_dir() else folder
    saved = read_policy(folder)
    names = [CONFIG, *saved.config["files"], CARD]
    push = (package or _package()).push_to_hub
    with contextlib.chdir(folder):  # it looks for the file in the current folder, whatever it is given
        for name in names:
            push(repo_id=repo_id, filename=name, commit_message=f"{saved.arm.name}: {name}")
    return names


def download(repo_id: str, package: Any = None) -> Path:
    """Download a policy's folder; the hub's cache keeps it.

    Raises:
        ConfigurationError: No `owner/name`, or huggingface_sb3 is not installed.
    """
    _check(repo_id)
    load = (package or _package()).load_from_hub
    config = Path(load(repo_id=repo_id, filename=CONFIG))
    for name in json.loads(config.read_text())["files"]:
        if name not in (MODEL, NORMALISATION, FILTER):
            raise ConfigurationError(f"{repo_id}: its {CONFIG} names a file that no policy has, {name!r}")
        load(repo_id=repo_id, filename=name)
    return config.parent


def _check(repo_id: str) -> None:
    owner, _, name = repo_id.partition("/")
    if not (owner and name) or "/" in name:
        raise ConfigurationError(f"expected owner/name of a repository on the hub, got {repo_id!r}")


def _package() -> Any:
    try:
        return importlib.import_module("huggingface_sb3")
    except ImportError as error:
        raise ConfigurationError(
            f"the hub needs huggingface_sb3, which cannot be imported ({error}): pip install 'safe-wrappers[hub]'"
        ) from None
