"""CSV tables of numbers, one row per episode: whole lines only, empty cells left out."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from safe_wrappers.errors import RunStateError
from safe_wrappers.wrappers.record_interventions import read_episodes

from .atomic import write_text

Row = Mapping[str, int | float | bool | str]


def write_rows(path: Path, columns: Sequence[str], rows: Iterable[Row]) -> None:
    """Writes a whole table, atomically."""
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
        return read_episodes(path) if path.exists() else []
    except (ValueError, TypeError, csv.Error) as error:
        raise RunStateError(
            f"{str(path)!r} is damaged ({error}); `safe-wrappers train` goes on from the checkpoint's copy."
        ) from None


def _lines(columns: Sequence[str], rows: Iterable[Row], header: bool) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    if header:
        writer.writeheader()
    writer.writerows({k: int(v) if isinstance(v, bool) else v for k, v in row.items()} for row in rows)
    return text.getvalue()
