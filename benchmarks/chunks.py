"""Long measurements in parts: each row is written as it comes, and a killed run goes on."""

import json
import multiprocessing
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TypeVar

Job = TypeVar("Job")
Row = dict[str, Any]


def known(path: Path, kind: type[Job]) -> dict[Job, Row]:
    """The rows of a file, one JSON object a line, by their jobs: dataclasses whose fields are in each row."""
    lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    found = [json.loads(line) for line in lines if line.endswith("\n")]  # a killed run's last one may be cut
    return {kind(**{key: row[key] for key in kind.__dataclass_fields__}): row for row in found}  # type: ignore[attr-defined]


def measured(
    path: Path, wanted: Sequence[Job], run: Callable[[Job], Row], workers: int, found: dict[Job, Row]
) -> dict[Job, Row]:
    """The rows of all jobs, in the order of the file.

    Args:
        path: Of the file, which is written anew with what was found, and then grows by one line per job.
        wanted: Jobs; those that were found are not run.
        run: Makes a job's row, with the job's fields in it.
        workers: Processes; 1: this one.
        found: Of an earlier run.
    """
    rows = dict(found)
    path.write_text("".join(json.dumps(row) + "\n" for row in rows.values()))
    left = [job for job in wanted if job not in rows]
    with ExitStack() as stack:
        file = stack.enter_context(path.open("a"))
        done: Iterable[Row] = map(run, left)
        if workers > 1:
            pool = stack.enter_context(multiprocessing.get_context("spawn").Pool(workers))
            done = pool.imap(run, left)
        for job, row in zip(left, done, strict=True):
            rows[job] = row
            file.write(json.dumps(row) + "\n")
            file.flush()
    return rows
