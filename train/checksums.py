"""Checksums: whether files are as they were written."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from safe_wrappers.errors import RunStateError


def checksums(paths: Iterable[Path]) -> dict[str, str]:
    """SHA-256 by file name, of those files that are there."""
    return {path.name: _checksum(path) for path in paths if path.is_file()}


def damage(folder: Path, files: Mapping[str, str]) -> str | None:
    """What is wrong with files of a folder, in words; None: all are as `checksums` had them."""
    for name, checksum in files.items():
        path = folder / name
        if not path.is_file():
            return f"{path} is missing"
        if _checksum(path) != checksum:
            return f"{path} is not as it was written (its checksum differs)"
    return None


def read_facts(path: Path, remedy: str) -> dict[str, Any]:
    """Reads a JSON object that this package wrote; empty where there is no such file.

    Args:
        path: The file.
        remedy: What to do about a damaged one, for the refusal.

    Raises:
        RunStateError: It is unreadable.
    """
    try:
        facts = json.loads(path.read_bytes())
        if not isinstance(facts, dict):
            raise ValueError("no JSON object")
    except FileNotFoundError:
        return {}
    except ValueError as error:  # of JSON, and of text that is none
        raise RunStateError(f"{str(path)!r} is unreadable ({error}); {remedy}") from None
    return facts


def _checksum(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
