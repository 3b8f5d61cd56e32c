"""Violations of SafePointGoal and SafeCarGoal under adversarial drivers, with the filter on and off.

    python -m benchmarks adversarial                                # 1,000,000 filtered steps per level, 5 drivers
    python -m benchmarks adversarial --mismatch                     # the plant wrong by 20 % in mass and damping
    python -m benchmarks adversarial --off --steps 100000           # the drivers unfiltered
    python -m benchmarks adversarial --robot car --steps 500000     # the same for SafeCarGoal, 7 drivers

A violation is a control step in which the env's own truth was broken at any physics substep
(`cost_substep`): the centre in a hazard disc, or, at level 2, a vase touched or moving.
"""

import argparse
import itertools
import warnings
from collections import Counter
from typing import Any, NamedTuple

import numpy as np

import safe_wrappers as sw
from benchmarks.cases import CASES, driven
from benchmarks.judges import counted
from benchmarks.tables import CORES, keep, made, markdown, options, total
from safe_wrappers.errors import UnsafeStateWarning


class Job(NamedTuple):
    """One driver on one level for so many steps."""

    level: int
    driver: str
    steps: int
    seed: int
    filtered: bool = True
    mass: float = 1.0
    damping: float = 1.0
    robot: str = "point"


def run(job: Job) -> dict[str, Any]:
    """Drive, count, and say what it cost."""
    warnings.simplefilter("ignore", UnsafeStateWarning)  # counted below
    case = CASES[f"Safe{job.robot.capitalize()}Goal{job.level}-v0"]
    env: Any = case.make()
    if job.filtered:
        plant = sw.MujocoPlant()
        plant.perturb(mass=job.mass, damping=job.damping)
        # True is the plant's times 1 / factor: 0.8 needs 25 % of uncertainty, 1.2 needs 17 %.
        wrong = {} if job.mass == job.damping == 1.0 else {"uncertainty": 0.25}
        env = sw.protect(env, plant=plant, **wrong)
    count = Counter[str]()
    returns: list[float] = []
    total, lowest = 0.0, np.inf
    steps = driven(case, env, job.driver, job.steps, job.seed, job.seed * 100_000)
    for _, reward, info, violated, over in steps:
        total += reward
        count.update(counted(info, violated))
        if job.filtered:
            lowest = min(lowest, info["cbf/margin"])
        if over:
            returns.append(total)
            total = 0.0
    mean = {"return_mean": float(np.mean(returns)) if returns else None}
    return {**job._asdict(), **count, **mean, "margin_min_m": float(lowest) if job.filtered else None}


def jobs(arguments: argparse.Namespace) -> list[Job]:
    """What to run."""
    robot = arguments.robot
    levels, names = (1, 2), list(CASES[f"Safe{robot.capitalize()}Goal1-v0"].drivers)
    steps = arguments.steps // len(names)
    if arguments.mismatch:
        wrong = list(itertools.product((0.8, 1.2), repeat=2))
        grid = itertools.product(levels, names, wrong)
        return [Job(lv, d, steps // 4, 2, True, m, c) for lv, d, (m, c) in grid]
    return [
        Job(lv, d, steps // arguments.parts, part, filtered=not arguments.off, robot=robot)
        for lv, d, part in itertools.product(levels, names, range(arguments.parts))
    ]


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: one line per level and driver, episodes and plants pooled."""
    lines = []

    def label(row: dict[str, Any]) -> tuple[Any, ...]:
        return row["level"], row["driver"], "on" if row["filtered"] else "off"

    for key, group in itertools.groupby(sorted(rows, key=label), label):
        part = list(group)
        steps = total(part, "steps")
        margins = [r["margin_min_m"] for r in part if r["margin_min_m"] is not None]
        returns = [r["return_mean"] for r in part if r["return_mean"] is not None]
        filtered: list[object] = ["-"] * 5
        if margins:
            flags = (total(part, flag) for flag in ("infeasible", "fallback", "unsafe"))
            filtered = [f"{total(part, 'intervened') / steps:.1%}", *flags, f"{1e3 * min(margins):.2f}"]
        counts = f"{steps:,}", f"{total(part, 'violations'):,}"
        lines.append([*key, *counts, *filtered, f"{np.mean(returns):.1f}"])
    head = "level | driver | filter | steps | violations | changed | infeasible | fallback | unsafe"
    sums = f"In all: {total(rows, 'violations'):,} violations in {total(rows, 'steps'):,} steps."
    return "\n".join([markdown(f"{head} | lowest h (mm) | return", lines), "", sums])


def main() -> None:
    """Run the jobs in parallel, print the table, keep the rows."""
    given = options(
        __doc__, steps=1_000_000, parts=4, workers=CORES, robot="point", mismatch=False, off=False
    )
    if given.mismatch and given.robot != "point":
        raise SystemExit("--mismatch is for the point: the car's filter declares no uncertainty")
    rows = list(made(run, jobs(given), given.workers))
    name = "mismatch" if given.mismatch else "off" if given.off else "filtered"
    keep(
        f"adversarial_{name}" if given.robot == "point" else f"adversarial_{given.robot}_{name}", table(rows)
    )
