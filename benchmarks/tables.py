"""What the scripts share: options, tables in Markdown, results, measurements in parts, and paired times."""

import argparse
import json
import multiprocessing
import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

RESULTS: Final = Path(__file__).parent / "results"
RUNS: Final = Path("runs")
CORES: Final = multiprocessing.cpu_count()
Job = TypeVar("Job")
Result = TypeVar("Result")
Row = dict[str, Any]


def options(doc: str | None, **defaults: Any) -> argparse.Namespace:
    """The command's options, `--like-this` for `like_this`; the module's docstring explains them.

    Args:
        doc: The docstring.
        defaults: By name. False makes a flag, a list takes words, a type stands for an option without a default.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawTextHelpFormatter)
    for name, default in defaults.items():
        option = f"--{name.replace('_', '-')}"
        if default is False:
            parser.add_argument(option, action="store_true")
        elif isinstance(default, list):
            parser.add_argument(option, nargs="+", default=default, metavar="WORD")
        elif isinstance(default, type):
            parser.add_argument(option, type=default)
        else:
            parser.add_argument(option, type=type(default), default=default, help="default: %(default)s")
    return parser.parse_args()


def markdown(head: str, rows: Iterable[Iterable[object]]) -> str:
    """A table.

    Args:
        head: Names of the columns with bars between them.
        rows: Cells, each as its text.
    """
    lines = [f"| {head} |", "|---" * (head.count("|") + 1) + "|"]
    return "\n".join([*lines, *(f"| {' | '.join(map(str, cells))} |" for cells in rows)])


def keep(name: str, text: str, whole: bool = True) -> None:
    """Prints a table, and writes it as `results/NAME.md` if it is whole."""
    print(text)
    if whole:
        (RESULTS / f"{name}.md").write_text(text + "\n")


def total(rows: Iterable[Row], key: str) -> int:
    """A count over all rows."""
    return sum(int(row[key]) for row in rows)


def made(run: Callable[[Job], Result], jobs: Sequence[Job], workers: int) -> Iterator[Result]:
    """What the jobs come to, in their order, by so many processes; 1: by this one."""
    if workers == 1:
        yield from map(run, jobs)
        return
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        yield from pool.imap(run, jobs)


def measured(path: Path, wanted: Sequence[Job], run: Callable[[Job], Row], workers: int) -> list[Row]:
    """The rows of the jobs that are wanted; a killed run goes on.

    Args:
        path: Of a file that grows by one line per job, and whose jobs are not run again.
        wanted: Named tuples.
        run: Makes a job's row, with the job's fields in it.
        workers: Processes; 1: this one.
    """
    if not wanted:
        return []
    lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    found = [json.loads(line) for line in lines if line.endswith("\n")]  # a killed run's last one may be cut
    kind: Any = type(wanted[0])
    rows = {kind(**{key: row[key] for key in kind._fields}): row for row in found}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(json.dumps(row) + "\n" for row in rows.values()))
    left = [job for job in wanted if job not in rows]
    with path.open("a") as file:
        for job, row in zip(left, made(run, left, workers), strict=True):
            rows[job] = row
            file.write(json.dumps(row) + "\n")
            file.flush()
    return [rows[job] for job in wanted]


def paired_us(sides: dict[str, Callable[[], object]], batch: int = 50, rounds: int = 40) -> dict[str, float]:
    """Median microseconds per call of each side, short batches in turn: a noisy machine hits all sides alike."""
    for call in sides.values():
        for _ in range(batch):
            call()
    samples: dict[str, list[float]] = {name: [] for name in sides}
    for _ in range(rounds):
        for name, call in sides.items():
            start = time.perf_counter()
            for _ in range(batch):
                call()
            samples[name].append((time.perf_counter() - start) / batch * 1e6)
    return {name: statistics.median(values) for name, values in samples.items()}
