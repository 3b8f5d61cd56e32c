"""Every env that `protect` knows, under drivers that make life hard: violations, with the filter and without.

    python -m benchmarks.protected                            # 10,000 steps per env with and without
    python -m benchmarks.protected --envs Reacher Pusher      # of the envs whose id has one of these words
    python -m benchmarks.protected --hard --steps 400000      # one row per driver; the envs with a hard limit
    python -m benchmarks.protected --resume                   # go on where a killed run stopped

A violation is a control step in which the env's own truth (`benchmarks/judges.py`) was broken at any physics
substep; for a published speed, over the step as a whole. Unflagged is one in a step that the filter reported
neither as infeasible or fallback nor as one that started unsafe. The overhead is the median over steps of how much
longer the env's step takes with the filter, against a second env that makes the same step without, split by whether
the filter changed the action.
"""

import argparse
import multiprocessing
import time
import warnings
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import chunks
from benchmarks.cases import CASES, HARD, PROTECTED, Case
from benchmarks.descriptions import constrained, promised, reserve
from benchmarks.tables import RESULTS, markdown, total
from safe_wrappers.errors import UnsafeStateWarning

CHUNK = 10_000
"""Steps of one job: what is lost when a run is killed."""
TIMED = 1_000
"""Of those, steps that are timed beside an env without the filter."""
_FLAGS = ("intervened", "infeasible", "fallback", "unsafe")


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
    case = CASES[job.case]
    bare = case.make()
    env = case.protect(bare) if job.filtered else bare
    twin = case.make() if job.filtered else None
    judge = case.judge(env.unwrapped)
    rng = np.random.default_rng(job.seed)
    driver = case.drivers[job.driver](env.unwrapped, rng)
    kind = env.action_space.dtype
    count = dict.fromkeys(("violations", "unflagged", "unsafe_starts", *_FLAGS), 0)
    ratios: dict[bool, list[float]] = {False: [], True: []}
    worst, episode, over = -np.inf, job.seed * 100_000, True
    started = time.perf_counter()
    for step in range(job.steps):
        while over:
            env.reset(seed=episode)
            if twin is not None:
                twin.reset(seed=episode)
            over = not judge.start() <= 0.0
            count["unsafe_starts"] += int(over)
            episode += 1
        action = np.asarray(driver(), dtype=kind)
        judge.before()
        begin = time.perf_counter()
        _, _, terminated, truncated, info = env.step(action)
        spent = time.perf_counter() - begin
        executed = info["executed_action"] if job.filtered else action
        missed = judge.after(executed, info)
        worst = max(worst, missed)
        violated = not missed <= 0.0  # so that what is not a number counts
        count["violations"] += int(violated)
        if twin is not None:
            for name in _FLAGS:
                count[name] += int(info[f"cbf/{name}"])
            flagged = info["cbf/infeasible"] or info["cbf/fallback"] or info["cbf/unsafe"]
            count["unflagged"] += int(violated and not flagged)
            if step < TIMED:
                begin = time.perf_counter()
                twin.step(np.asarray(executed, dtype=kind))
                ratios[bool(info["cbf/intervened"])].append(spent / (time.perf_counter() - begin))
        over = bool(truncated or (terminated and not case.past_termination))
    spent = {"worst": float(worst), "seconds": time.perf_counter() - started}
    return asdict(job) | count | _timings(ratios) | spent


def _timings(ratios: dict[bool, list[float]]) -> dict[str, Any]:
    row: dict[str, Any] = {}
    for changed, name in ((False, "inactive"), (True, "active")):
        row[f"{name}_timed"] = len(ratios[changed])
        row[f"{name}_ratio"] = float(np.median(ratios[changed])) if ratios[changed] else None
    return row


def jobs(cases: dict[str, Case], arguments: argparse.Namespace) -> list[Job]:
    """What to run: the steps of each env are split between its drivers, and those of a driver into chunks."""
    found = []
    for name, case in cases.items():
        if arguments.envs and not any(word in name for word in arguments.envs):
            continue
        drivers = [d for d in case.drivers if not arguments.drivers or d in arguments.drivers]
        for filtered in (False,) if arguments.off else (True, False):
            for driver in drivers:
                left, seed = max(arguments.steps // len(drivers), 1), arguments.seed
                while left > 0:
                    found.append(Job(name, driver, filtered, min(left, CHUNK), seed))
                    left, seed = left - CHUNK, seed + 1
    return found


def _overhead(rows: list[dict[str, Any]], which: str) -> str:
    """Medians of the parts, weighted by their steps; a few steps say nothing."""
    timed = [(row[f"{which}_ratio"], row[f"{which}_timed"]) for row in rows if row[f"{which}_timed"]]
    steps = sum(n for _, n in timed)
    return f"{sum(r * n for r, n in timed) / steps:.1f}" if steps >= 20 else "-"


def _per_driver(rows: list[dict[str, Any]]) -> list[tuple[tuple[str, str, bool], list[dict[str, Any]]]]:
    groups: dict[tuple[str, str, bool], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["case"], row["driver"], row["filtered"]), []).append(row)
    return list(groups.items())


def table_of_envs(cases: dict[str, Case], rows: list[dict[str, Any]]) -> str:
    """Markdown: one line per env, drivers pooled."""
    lines = []
    for name, case in cases.items():
        on = [r for r in rows if r["case"] == name and r["filtered"]]
        off = [r for r in rows if r["case"] == name and not r["filtered"]]
        if not on and not off:
            continue
        env = case.protect(case.make())
        ids = ", ".join((name, *case.also))
        cells = [ids, constrained(env), promised(env), reserve(env)]
        if on:
            cells += [f"{_overhead(on, 'inactive')} / {_overhead(on, 'active')}", _violations(on)]
        else:
            cells += ["-", "-"]
        cells.append(f"{total(off, 'violations'):,}" if off else "-")
        cells.append(f"{total(on or off, 'steps'):,}")
        share = total(on, "intervened") / max(total(on, "steps"), 1)
        cells += (
            [f"{share:.1%}", f"{total(on, 'infeasible'):,}", f"{total(on, 'fallback'):,}"]
            if on
            else ["-"] * 3
        )
        lines.append(cells)
    head = "env | what is constrained | class | reserve | step time, inactive / active | violations on | off"
    return markdown(f"{head} | steps each | changed | infeasible | fallback", lines)


def table_of_drivers(rows: list[dict[str, Any]]) -> str:
    """Markdown: one line per env, driver and filter."""
    lines = []
    for (name, driver, filtered), part in _per_driver(rows):
        steps = total(part, "steps")
        flags = (
            [f"{total(part, 'intervened') / steps:.1%}"] + [f"{total(part, flag):,}" for flag in _FLAGS[1:]]
            if filtered
            else ["-"] * 4
        )
        worst = max(row["worst"] for row in part)
        cells = [name, driver, "on" if filtered else "off", f"{steps:,}", _violations(part)]
        lines.append([*cells, *flags, f"{worst:.3g}"])
    head = "env | driver | filter | steps | violations | changed | infeasible | fallback | unsafe | worst"
    skipped = f"Starts left out because they were unsafe: {total(rows, 'unsafe_starts'):,}."
    return "\n".join([markdown(head, lines), "", skipped])


def _violations(rows: list[dict[str, Any]]) -> str:
    violations, unflagged = total(rows, "violations"), total(rows, "unflagged")
    return f"{violations:,} ({unflagged:,} unflagged)" if unflagged else f"{violations:,}"


def main() -> None:
    """Run the jobs, write each row as it comes, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "--steps", type=int, default=10_000, help="per env and arm, split between its drivers"
    )
    parser.add_argument("--envs", nargs="+", help="words; an env whose name has one of them is run")
    parser.add_argument("--drivers", nargs="+", help="names; all by default")
    parser.add_argument("--hard", action="store_true", help="the envs with a hard limit, one row per driver")
    parser.add_argument("--off", action="store_true", help="without the filter only")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=multiprocessing.cpu_count())
    parser.add_argument(
        "--resume", action="store_true", help="keep the rows of a killed run of the same command"
    )
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder for the rows and the table")
    arguments = parser.parse_args()
    cases = HARD if arguments.hard else PROTECTED
    wanted = jobs(cases, arguments)
    if not wanted:
        parser.error(f"nothing to run; the envs are: {', '.join(cases)}")
    name = "protected_hard" if arguments.hard else "protected"
    arguments.results.mkdir(parents=True, exist_ok=True)
    path = arguments.results / f"{name}.jsonl"
    found = chunks.known(path, Job) if arguments.resume else {}
    kept = {job: found[job] for job in wanted if job in found}
    rows = chunks.measured(path, wanted, run, arguments.workers, kept)
    ordered = [rows[job] for job in wanted]
    text = table_of_drivers(ordered) if arguments.hard else table_of_envs(cases, ordered)
    (arguments.results / f"{name}.md").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
