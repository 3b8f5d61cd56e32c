"""Files that are there whole or not at all, tables of them, and one writer per folder; and lines on the terminal."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from filelock import FileLock, Timeout
from rich.console import Console

from safe_wrappers.errors import RunStateError

Row = Mapping[str, int | float | bool | str]
_PATIENCE_S: Final = 5.0
"""A process whose parent was killed has let go of its folder by then."""


def say(console: Console, text: str) -> None:
    """Prints a line as it is: not broken, nothing in it coloured or read as markup."""
    console.print(text, highlight=False, markup=False, soft_wrap=True)


def write_bytes(path: Path, data: bytes) -> None:
    """Writes a file beside its place and moves it there, so that a kill leaves the old one or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.tmp")  # of a killed process: written over
    with temporary.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())  # or a power cut could leave the new name on an empty file
    os.replace(temporary, path)


def write_text(path: Path, text: str) -> None:
    """`write_bytes` of UTF-8 text."""
    write_bytes(path, text.encode())


def write_json(path: Path, value: Any) -> None:
    """`write_bytes` of readable JSON."""
    write_text(path, json.dumps(value, indent=2, sort_keys=True) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """Reads a JSON object that this package wrote; empty where there is no such file.

    Raises:
        RunStateError: It is unreadable.
    """
    try:
        found = json.loads(path.read_bytes())
        if not isinstance(found, dict):
            raise ValueError("no JSON object")
    except FileNotFoundError:
        return {}
    except ValueError as error:  # of JSON, and of text that is none
        raise RunStateError(
            f"{str(path)!r} is unreadable ({error}); delete it to have it made again."
        ) from None
    return found


def write_rows(path: Path, columns: Sequence[str], rows: Iterable[Row]) -> None:
    """Writes a whole CSV table, atomically; what a row does not have is an empty cell."""
    write_text(path, _lines(columns, rows, header=True))


def append_row(path: Path, columns: Sequence[str], row: Row) -> None:
    """Adds one row to a table that `write_rows` began; a kill leaves at most one half line, at its end."""
    with path.open("a", newline="") as file:
        file.write(_lines(columns, [row], header=False))


def read_rows(path: Path) -> list[dict[str, float]]:
    """Reads a table of numbers; a half-written last line and empty cells are left out.

    Raises:
        RunStateError: It is no table of numbers.
    """
    try:
        data = path.read_bytes() if path.exists() else b""
        # A number cut short still reads as a number, so only the newline tells that a line is whole.
        rows = csv.DictReader(io.StringIO(data[: data.rfind(b"\n") + 1].decode()))
        return [{key: float(value) for key, value in row.items() if value != ""} for row in rows]
    except (ValueError, TypeError, csv.Error) as error:
        raise RunStateError(f"{str(path)!r} is no table of numbers ({error}).") from None


def _lines(columns: Sequence[str], rows: Iterable[Row], header: bool) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    if header:
        writer.writeheader()
    writer.writerows({k: int(v) if isinstance(v, bool) else v for k, v in row.items()} for row in rows)
    return text.getvalue()


@contextlib.contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Holds the folder for this process; the system lets go of it when the process ends, however it ends.

    Raises:
        RunStateError: Another process holds it for more than 5 s.
    """
    folder.mkdir(parents=True, exist_ok=True)
    try:
        held = FileLock(folder / ".lock").acquire(_PATIENCE_S)
    except Timeout:
        raise RunStateError(
            f"Another process is working in {str(folder)!r}; wait for it, or end it first."
        ) from None
    with held:
        yield
