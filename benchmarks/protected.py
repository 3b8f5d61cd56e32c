"""Every env that `protect` knows, under drivers that make life hard: violations, with the filter and without.

    python -m benchmarks protected --steps 3000            # of each env with and without; goes on if stopped
    python -m benchmarks protected --envs Reacher Pusher   # of the envs whose name has one of these words

A violation is a control step in which the env's own truth (`benchmarks/judges.py`) was broken at any physics
substep; for a published speed, over the step as a whole. Unflagged is one in a step that the filter reported
neither as infeasible or fallback nor as one that started unsafe. The overhead is the median over steps of how much
longer the env's step takes with the filter, against a second env that makes the same step without, split by whether
the filter changed the action.
"""

import itertools
import multiprocessing
import time
import warnings
from collections import Counter
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from benchmarks.cases import PROTECTED, Case
from benchmarks.judges import counted
from benchmarks.tables import RUNS, keep, markdown, measured, options, total
from safe_wrappers.errors import UnsafeStateWarning

CHUNK = 10_000
"""Steps of one job: what is lost when a run is killed."""
TIMED = 1_000
"""Of those, steps that are timed beside an env without the filter."""


@dataclass(frozen=True)
class Job:
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
    bare = case.make()
    env = case.protect(bare) if job.filtered else bare
    twin = case.make() if job.filtered else None
    judge = case.judge(env.unwrapped)
    rng = np.random.default_rng(job.seed)
    driver = case.drivers[job.driver](env.unwrapped, rng)
    kind = env.action_space.dtype
    count = Counter[str]()
    ratios: dict[str, list[float]] = {"inactive": [], "active": []}
    episode, over = job.seed * 100_000, True
    for step in range(job.steps):
        while over:
            env.reset(seed=episode)
            if twin is not None:
                twin.reset(seed=episode)
            over = not judge.start() <= 0.0
            episode += 1
        action = np.asarray(driver(), dtype=kind)
        judge.before()
        begin = time.perf_counter()
        _, _, terminated, truncated, info = env.step(action)
        spent = time.perf_counter() - begin
        executed = info["executed_action"] if job.filtered else action
        missed = judge.after(executed, info)
        count.update(counted(info, not missed <= 0.0))  # so that what is not a number counts
        if twin is not None and step < TIMED:
            begin = time.perf_counter()
            twin.step(np.asarray(executed, dtype=kind))
            ratios["active" if info["cbf/intervened"] else "inactive"].append(
                spent / (time.perf_counter() - begin)
            )
        over = bool(truncated or (terminated and not case.past_termination))
    row = {**asdict(job), **count}
    for name, timed in ratios.items():
        row |= {f"{name}_timed": len(timed), f"{name}_ratio": float(np.median(timed)) if timed else None}
    return row


def jobs(cases: dict[str, Case], steps: int) -> list[Job]:
    """What to run: the steps of each env are split between its drivers, and those of a driver into chunks."""
    found = []
    for (name, case), filtered in itertools.product(cases.items(), (True, False)):
        for driver in case.drivers:
            each = max(steps // len(case.drivers), 1)
            for seed, first in enumerate(range(0, each, CHUNK)):
                found.append(Job(name, driver, filtered, min(each - first, CHUNK), seed))
    return found


def _overhead(rows: list[dict[str, Any]], which: str) -> str:
    """Medians of the parts, weighted by their steps; a few steps say nothing."""
    timed = [(row[f"{which}_ratio"], row[f"{which}_timed"]) for row in rows if row[f"{which}_timed"]]
    steps = sum(n for _, n in timed)
    return f"{sum(r * n for r, n in timed) / steps:.1f}" if steps >= 20 else "-"


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
        times = f"{_overhead(on, 'inactive')} / {_overhead(on, 'active')}"
        cells = [
            ", ".join((name, *cases[name].also)),
            "; ".join(kinds),
            "proved" if proved else "best effort",
        ]
        cells += [times, _violations(on), f"{total(off, 'violations'):,}", f"{total(on, 'steps'):,}"]
        cells.append(f"{total(on, 'intervened') / total(on, 'steps'):.1%}")
        lines.append([*cells, *(f"{total(on, flag):,}" for flag in ("infeasible", "fallback"))])
    head = "env | constraints | class | step time, inactive / active | violations on | off"
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


def _violations(rows: list[dict[str, Any]]) -> str:
    violations, unflagged = total(rows, "violations"), total(rows, "unflagged")
    return f"{violations:,} ({unflagged:,} unflagged)" if unflagged else f"{violations:,}"


def main() -> None:
    """Run the jobs, write each row as it comes, print the table."""
    given = options(__doc__, steps=10_000, envs=[], workers=multiprocessing.cpu_count())
    cases = {
        name: case
        for name, case in PROTECTED.items()
        if not given.envs or any(word in name for word in given.envs)
    }
    rows = measured(RUNS / "protected/protected.jsonl", jobs(cases, given.steps), run, given.workers)
    keep("protected", table(cases, rows), not given.envs)
