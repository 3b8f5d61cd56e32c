"""Every env that `protect` knows, under drivers that make life hard: violations, with the filter and without.

    python -m benchmarks protected --steps 3000            # of each env with and without; goes on if stopped
    python -m benchmarks protected --envs Reacher Pusher   # of the envs whose name has one of these words

A violation is a control step in which the env's own truth (`benchmarks/judges.py`) was broken at any physics
substep; for a published speed, over the step as a whole. Unflagged is one in a step that the filter reported
neither as infeasible or fallback nor as one that started unsafe.
"""

import itertools
import warnings
from collections import Counter
from dataclasses import fields
from typing import Any, NamedTuple

from benchmarks.cases import PROTECTED, Case, driven
from benchmarks.judges import counted
from benchmarks.tables import CORES, RUNS, keep, markdown, measured, options, total
from safe_wrappers.errors import UnsafeStateWarning

CHUNK = 10_000
"""Steps of one job: what is lost when a run is killed."""


class Job(NamedTuple):
    """One driver on one env for so many steps."""

    case: str
    driver: str
    filtered: bool
    steps: int
    seed: int


def run(job: Job) -> dict[str, Any]:
    """Drive, judge and count."""
    warnings.simplefilter("ignore", UnsafeStateWarning)  # counted below
    case = PROTECTED[job.case]
    env = case.protect(case.make()) if job.filtered else case.make()
    count = Counter[str]()
    for _, _, info, violated, _ in driven(case, env, job.driver, job.steps, job.seed, job.seed * 100_000):
        count.update(counted(info, violated))
    return {**job._asdict(), **count}


def jobs(cases: dict[str, Case], steps: int) -> list[Job]:
    """What to run: the steps of each env are split between its drivers, and those of a driver into chunks."""
    found = []
    for (name, case), filtered in itertools.product(cases.items(), (True, False)):
        for driver in case.drivers:
            each = max(steps // len(case.drivers), 1)
            for seed, first in enumerate(range(0, each, CHUNK)):
                found.append(Job(name, driver, filtered, min(each - first, CHUNK), seed))
    return found


def table(cases: dict[str, Case], rows: list[dict[str, Any]]) -> str:
    """Markdown: one line per env, drivers pooled."""
    lines = []
    for name in dict.fromkeys(row["case"] for row in rows):
        on, off = (
            [row for row in rows if row["case"] == name and row["filtered"] is kind] for kind in (True, False)
        )
        env = cases[name].protect(cases[name].make())
        kinds = map(spelled, env.constraints)
        proved = all(getattr(c, "promise", "best effort") == "proved" for c in env.constraints)
        cells = [
            ", ".join((name, *cases[name].also)),
            "; ".join(kinds),
            "proved" if proved else "best effort",
        ]
        violations, unflagged = total(on, "violations"), total(on, "unflagged")
        counts = f"{violations:,} ({unflagged:,} unflagged)" if unflagged else f"{violations:,}"
        cells += [counts, f"{total(off, 'violations'):,}", f"{total(on, 'steps'):,}"]
        cells.append(f"{total(on, 'intervened') / total(on, 'steps'):.1%}")
        lines.append([*cells, *(f"{total(on, flag):,}" for flag in ("infeasible", "fallback"))])
    head = "env | constraints | class | violations on | off"
    return markdown(f"{head} | steps each | changed | infeasible | fallback", lines)


def spelled(constraint: Any) -> str:
    """A constraint with the numbers and names that it was given, where they are not its defaults."""

    def short(value: Any) -> str:
        if isinstance(value, float):
            return f"{value:g}"
        return f"({', '.join(map(short, value))})" if isinstance(value, list | tuple) else str(value)

    told = []
    for one in fields(constraint):
        value = getattr(constraint, one.name)
        if one.init and value and value != one.default and type(value) in (int, float, str, list, tuple):
            told += [f"{one.name} {short(value)}"] if len(short(value)) < 60 else []
    return f"{type(constraint).__name__}: {', '.join(told)}" if told else type(constraint).__name__


def main() -> None:
    """Run the jobs, write each row as it comes, print the table."""
    given = options(__doc__, steps=10_000, envs=[], workers=CORES)
    cases = {
        name: case
        for name, case in PROTECTED.items()
        if not given.envs or any(word in name for word in given.envs)
    }
    rows = measured(RUNS / "protected/protected.jsonl", jobs(cases, given.steps), run, given.workers)
    keep("protected", table(cases, rows), not given.envs)
