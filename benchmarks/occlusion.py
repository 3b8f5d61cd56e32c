"""What keeping clear of estimates is worth: collisions with obstacles that are not seen all the time.

    python -m benchmarks occlusion    # 40,000 steps per driver and filter: half an hour; --steps 2000: a look

OccludedCrossing, with the sensor and tracks of its trainings, under drivers that know nothing of cars. The truth is
the env's: the states of its cars, and its own judge of collisions at every physics substep.
"""

import itertools
import warnings
from typing import Any, NamedTuple

import safe_wrappers as sw
from benchmarks.cases import CASES, crossing, driven
from benchmarks.drivers import CROSSING
from benchmarks.tables import RUNS, keep, markdown, measured, options, total
from safe_wrappers.errors import UnsafeStateWarning

ARMS: dict[str, dict[str, Any] | None] = {
    "no filter": None,
    "last seen": {"cars": "last_seen"},
    "true state": {"cars": "true"},
    **{f"estimate, k = {k}": {"cars": "estimated", "sigmas": float(k)} for k in (1, 2, 3)},
}
PART = 5_000
"""Steps of a job."""


class Job(NamedTuple):
    """One driver under one filter for so many steps."""

    driver: str
    arm: str
    steps: int
    seed: int


def run(job: Job) -> dict[str, Any]:
    """Drive, count."""
    warnings.simplefilter("ignore", UnsafeStateWarning)  # counted below
    case, settings = CASES["OccludedCrossing-v0"], ARMS[job.arm]
    env: Any = crossing(case.make())
    if settings is not None:
        env = sw.protect(env, **settings)
    count = dict.fromkeys(("collisions", "unflagged", "goals", "intervened", "flagged"), 0)
    for _, _, info, _, _ in driven(case, env, job.driver, job.steps, job.seed, 100_000 * job.seed):
        flagged = any(info.get(f"cbf/{name}", False) for name in ("infeasible", "fallback", "unsafe"))
        count["collisions"] += int(info["collisions"])
        count["unflagged"] += int(info["collisions"]) * (not flagged)
        count["goals"] += int(info["goal_met"])
        count["flagged"] += flagged
        count["intervened"] += bool(info.get("cbf/intervened", False))
    return job._asdict() | count


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: a row per filter, all drivers together."""
    lines = []
    for arm, settings in ARMS.items():
        part = [row for row in rows if row["arm"] == arm]
        steps, collisions = total(part, "steps"), total(part, "collisions")
        cells = [arm, f"{steps:,}", f"{collisions:,}", f"{1e6 * collisions / steps:,.0f}"]
        shares = [f"{total(part, key) / steps:.2%}" for key in ("intervened", "flagged")]
        cells += ["-"] * 3 if settings is None else [str(total(part, "unflagged")), *shares]
        lines.append([*cells, f"{1e3 * total(part, 'goals') / steps:.2f}"])
    head = "filter keeps clear of | steps | collisions | per million | in a step not flagged | changed"
    return markdown(f"{head} | flagged | goals / 1,000 steps", lines)


def main() -> None:
    """Run what is missing, print the table."""
    given = options(__doc__, steps=40_000, workers=2)
    size = min(given.steps, PART)
    kinds = itertools.product(range(given.steps // size), CROSSING, ARMS)
    jobs = [Job(driver, arm, size, seed) for seed, driver, arm in kinds]
    keep("occlusion", table(measured(RUNS / "occlusion/occlusion.jsonl", jobs, run, given.workers)))
