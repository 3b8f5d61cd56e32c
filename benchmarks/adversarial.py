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
import multiprocessing
import warnings
from collections import Counter
from dataclasses import asdict, dataclass
from typing import Any

import gymnasium as gym
import numpy as np

import safe_wrappers as sw
from benchmarks import car_drivers, drivers
from benchmarks.judges import counted
from benchmarks.tables import keep, markdown, options, total
from safe_wrappers.errors import UnsafeStateWarning

DRIVERS = {"point": drivers.DRIVERS, "car": car_drivers.DRIVERS}


@dataclass(frozen=True)
class Job:
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
    env: Any = gym.make(f"Safe{job.robot.capitalize()}Goal{job.level}-v0")
    if job.filtered:
        plant = sw.MujocoPlant()
        plant.perturb(mass=job.mass, damping=job.damping)
        # True is the plant's times 1 / factor: 0.8 needs 25 % of uncertainty, 1.2 needs 17 %.
        wrong = {} if job.mass == job.damping == 1.0 else {"uncertainty": 0.25}
        env = sw.protect(env, plant=plant, **wrong)
    raw = env.unwrapped
    driver = DRIVERS[job.robot][job.driver](raw, np.random.default_rng(job.seed))
    count = Counter[str]()
    returns: list[float] = []
    total, lowest, episode = 0.0, np.inf, job.seed * 100_000
    env.reset(seed=episode)
    for _ in range(job.steps):
        _, reward, _, truncated, info = env.step(driver())
        total += float(reward)
        count.update(counted(info, info["cost_substep"] > 0.0))
        if job.filtered:
            lowest = min(lowest, info["cbf/margin"])
        if truncated:
            returns.append(total)
            total, episode = 0.0, episode + 1
            env.reset(seed=episode)
    mean = {"return_mean": float(np.mean(returns)) if returns else None}
    return {**asdict(job), **count, **mean, "margin_min_m": float(lowest) if job.filtered else None}


def jobs(arguments: argparse.Namespace) -> list[Job]:
    """What to run."""
    robot = arguments.robot
    levels, names = (1, 2), list(DRIVERS[robot])
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
    workers = multiprocessing.cpu_count()
    given = options(
        __doc__, steps=1_000_000, parts=4, workers=workers, robot="point", mismatch=False, off=False
    )
    if given.mismatch and given.robot != "point":
        raise SystemExit("--mismatch is for the point: the car's filter declares no uncertainty")
    with multiprocessing.get_context("spawn").Pool(given.workers) as pool:
        rows = pool.map(run, jobs(given), chunksize=1)
    name = "mismatch" if given.mismatch else "off" if given.off else "filtered"
    keep(
        f"adversarial_{name}" if given.robot == "point" else f"adversarial_{given.robot}_{name}", table(rows)
    )
