"""How long the proved filters hold against attackers: violations, lowest margins, memory and speed over many steps.

    python -m benchmarks endurance                    # 5,000,000 control steps; goes on where it was killed
    python -m benchmarks endurance --steps 20000000   # and farther

Chunks of one env, driver and seed are made one after the other in the same process, each a line in
`runs/endurance/endurance.jsonl`. The hand-written drivers attack 16 envs at once through a `VectorCBFActionFilter`.
CEM and differences search 30 steps ahead in copies of the env, filter included. The learner is PPO that is paid for
violations, anew in each chunk.

A violation is a control step in which the env's own truth (`benchmarks/judges.py`) was broken at any physics substep.
The memory of the process is read at a chunk's end, after the allocator has given back what is free.
"""

import ctypes
import gc
import importlib.metadata
import os
import platform
import warnings
import zlib
from dataclasses import asdict
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium.vector import SyncVectorEnv

import safe_wrappers as sw
from benchmarks import trained_adversary
from benchmarks.cases import CASES
from benchmarks.drivers import Maker
from benchmarks.judges import counted
from benchmarks.mujoco_drivers import corner_seeking
from benchmarks.searching_drivers import SEARCHES, SearchingDriver
from benchmarks.tables import keep, markdown, measured, options, total
from benchmarks.trained_adversary import FLAGS, Tally
from safe_wrappers.errors import UnsafeStateWarning

ENVS = (
    "SafePointGoal1-v0",
    "SafePointGoal2-v0",
    "SafeCarGoal1-v0",
    "SafeCarGoal2-v0",
    "PointMaze_UMaze-v3",
    "PointMaze_Large-v3",
)
LEARNER = "learner"
STEPS = {"hand": 50_000, "off": 5_000, "search": 1_000, LEARNER: 50_000}
"""Control steps of a chunk, by the kind of driver; `off` is a hand-written one without the filter."""
CARS_EVERY, SEARCHES_EVERY = 3, 10
"""Rounds: a car's step takes four times as long as a point's, and one of a search a hundred times."""
TOGETHER = 16
"""Envs that a hand-written driver attacks at once."""
_READ = ("cost_substep", "cbf/margin", *(f"cbf/{name}" for name in FLAGS))
_VERSIONS = ("safe-wrappers", "mujoco", "gymnasium", "gymnasium-robotics", "numpy", "numba", "torch")


class Chunk(NamedTuple):
    """One driver on one env for about so many steps."""

    env: str
    driver: str
    planned: int
    seed: int
    filtered: bool = True


def hand_written(env: str) -> dict[str, Maker]:
    """The drivers of an env that know what they look for."""
    found = dict(CASES[env].drivers)
    if "Maze" in env:
        found["corner-seeking"] = corner_seeking
    return found


def plan(steps: int) -> list[Chunk]:
    """Whole chunks of at least so many filtered steps: rounds through the drivers, the envs by turns."""
    kinds = [
        [
            *((name, "hand") for name in hand_written(env)),
            (LEARNER, LEARNER),
            *((s, "search") for s in SEARCHES),
        ]
        for env in ENVS
    ]
    found: list[Chunk] = []
    planned = seed = 0
    while True:
        for turn in zip_longest(*kinds):
            for env, pair in zip(ENVS, turn, strict=True):
                if pair is None:
                    continue
                if seed % (SEARCHES_EVERY if pair[1] == "search" else CARS_EVERY if "Car" in env else 1):
                    continue
                if planned >= steps:
                    return found
                driver, kind = pair
                if seed == 0 and kind == "hand":
                    found.append(Chunk(env, driver, STEPS["off"], 0, filtered=False))
                found.append(Chunk(env, driver, STEPS[kind], seed))
                planned += STEPS[kind]
        seed += 1


def run(chunk: Chunk) -> dict[str, Any]:
    """Attack, judge and count; then look at the process."""
    warnings.simplefilter("ignore", UnsafeStateWarning)  # counted
    row = learn(chunk) if chunk.driver == LEARNER else attack(chunk)
    process = f"{os.getpid()} of {Path('/proc/self/stat').read_text().split()[21]}"
    known = [f"{name} {importlib.metadata.version(name)}" for name in _VERSIONS]
    versions = ", ".join([f"Python {platform.python_version()}", *known])
    return chunk._asdict() | row | {"mb": used_mb(), "process": process, "versions": versions}


def attack(chunk: Chunk) -> dict[str, Any]:
    """Drive the envs of a chunk together, or the one of a driver that searches."""
    envs, drivers = attacked(chunk)
    judges = [CASES[chunk.env].judge(single.unwrapped) for single in envs.unwrapped.envs]
    tally = Tally()
    ended = np.zeros(envs.num_envs, dtype=bool)
    actions = np.zeros(envs.action_space.shape, envs.action_space.dtype)
    while tally.steps < chunk.planned:
        judged = np.flatnonzero(~ended).tolist()
        for i in judged:
            actions[i] = drivers[i]()
            judges[i].before()
        _, _, terminated, truncated, infos = envs.step(actions)
        for i in judged:
            info = {key: infos[key][i].item() for key in _READ if key in infos}
            missed = judges[i].after(infos["executed_action"][i] if chunk.filtered else actions[i], info)
            found = counted(info, not missed <= 0.0)  # so that what is not a number counts
            tally = tally.plus(Tally(1, **found, smallest=info.get("cbf/margin")))
        ended = terminated | truncated
    row = asdict(tally)
    envs.close()
    for name in ("simulated", "simulated_violations"):
        row[name] = sum(getattr(driver, name, 0) for driver in drivers)
    return row


def attacked(chunk: Chunk) -> tuple[Any, list[Any]]:
    """The vector env of a chunk, reset, and the driver of each env; all of it follows from the seed."""
    case, search = CASES[chunk.env], SEARCHES.get(chunk.driver)
    n = 1 if search else TOGETHER
    envs: Any = SyncVectorEnv([(lambda: case.protect(case.make())) if search else case.make] * n)
    if chunk.filtered and not search:
        envs = sw.protect(envs)
    own = zlib.crc32(f"{chunk.env} {chunk.driver}".encode())  # no driver starts where another does
    seeds = [int(seed) for seed in np.random.SeedSequence([chunk.seed, own]).generate_state(2 * n)]
    envs.reset(seed=seeds[:n])
    rngs = map(np.random.default_rng, seeds[n:])
    if search:
        return envs, [SearchingDriver(env, rng, search) for env, rng in zip(envs.envs, rngs, strict=True)]
    make = hand_written(chunk.env)[chunk.driver]
    return envs, [make(env.unwrapped, rng) for env, rng in zip(envs.unwrapped.envs, rngs, strict=True)]


def learn(chunk: Chunk) -> dict[str, Any]:
    """Train PPO on violations, through the filter, and evaluate it; all filtered steps count."""
    # PPO's envs have the seeds after its own.
    job = trained_adversary.Job(chunk.env, chunk.planned, 1000 * chunk.seed)
    found = trained_adversary.run(job, episodes=2)
    tally = Tally()
    for part in ("training", "deterministic", "stochastic"):
        tally = tally.plus(Tally(**found[part]))
    without = found["unfiltered"]
    return asdict(tally) | {"off_steps": without["steps"], "off_violations": without["violations"]}


def collected(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Sums per env and driver, and what memory did over the steps of each process."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["env"], row["driver"]), []).append(row)
    envs = list(dict.fromkeys(row["env"] for row in rows))
    ordered = sorted(groups, key=lambda pair: envs.index(pair[0]))  # drivers as they came
    return {
        "drivers": [_pooled(groups[pair]) for pair in ordered],
        "memory": [
            m for process in dict.fromkeys(row["process"] for row in rows) if (m := memory(rows, process))
        ],
        "versions": sorted({row["versions"] for row in rows}),
    }


def _pooled(rows: list[dict[str, Any]]) -> dict[str, Any]:
    tally, off = Tally(), Tally()
    extra = dict.fromkeys(("simulated", "simulated_violations"), 0)
    for row in rows:
        part = Tally(**{name: row[name] for name in Tally.__dataclass_fields__})
        if not row["filtered"]:
            off = off.plus(part)
            continue
        tally = tally.plus(part)
        off = off.plus(Tally(row.get("off_steps", 0), row.get("off_violations", 0)))
        for name in extra:
            extra[name] += row.get(name, 0)
    extra |= {"off_steps": off.steps, "off_violations": off.violations}
    return {"env": rows[0]["env"], "driver": rows[0]["driver"], **asdict(tally), **extra}


def memory(rows: list[dict[str, Any]], process: str) -> dict[str, Any] | None:
    """What the memory of one process did after its first round, from a line through the ends of its chunks.

    Counted are chunks of a kind that it has made before, over the filtered steps that it had made by then.
    """
    seen, warm, made = set(), [], 0
    for row in rows:
        if row["process"] == process:
            made += row["steps"] * row["filtered"]
            kind = row["env"], row["driver"], row["filtered"]
            if kind in seen:
                warm.append((float(made), row["mb"]))
            seen.add(kind)
    if len(warm) < 3:
        return None
    steps, mb = np.array(warm).T
    span = steps[-1] - steps[0]
    growth = float(np.polyfit(steps, mb, 1)[0]) * span / float(mb.mean())
    ends = {"least_mb": float(mb.min()), "most_mb": float(mb.max())}
    return {"chunks": len(warm), "steps": int(span), "growth": growth, **ends}


def table(found: dict[str, Any]) -> str:
    """Markdown: a line per env and driver, one per env, and what memory did."""
    rows = [row for row in found["drivers"] if row["steps"]]
    lines, sums = [], []
    for r in rows:
        off = f"{1e3 * r['off_violations'] / r['off_steps']:.0f}" if r["off_steps"] else "-"
        counts = [r["env"], r["driver"], f"{r['steps']:,}", f"{r['violations']:,}", off]
        flags = [f"{r['intervened'] / r['steps']:.1%}", *(f"{r[name]:,}" for name in FLAGS[1:])]
        lines.append([*counts, *flags, f"{1e3 * r['smallest']:.3f}", r["simulated"] or "-"])
    for env in [*dict.fromkeys(r["env"] for r in rows), ""]:
        part = [r for r in rows if env in ("", r["env"])]
        steps, bad = total(part, "steps"), total(part, "violations")
        bound = f"{3.0 / steps:.1e} a step" if not bad else "-"
        sums.append(
            [env or "all", f"{steps:,}", f"{bad:,}", bound, f"{1e3 * min(r['smallest'] for r in part):.3f}"]
        )
    head = (
        "env | driver | steps | violations | without the filter, of 1,000 | changed | infeasible | fallback"
    )
    by_driver = markdown(f"{head} | unsafe | lowest h (mm) | simulated steps", lines)
    by_env = markdown("env | steps | violations | at most, at 95 % | lowest h (mm)", sums)
    simulated, bad = total(rows, "simulated"), total(rows, "simulated_violations")
    said = [f"Of {simulated:,} steps that searches simulated, {bad:,} were in violation.", ""]
    for m in found["memory"]:
        said.append(
            f"Memory of a process after its first round, over {m['steps']:,} steps in {m['chunks']} chunks: "
            f"{m['least_mb']:.0f} to {m['most_mb']:.0f} MB; a line through them grows by {m['growth']:.2%}."
        )
    return "\n".join([by_driver, "", by_env, "", *said, "", *found["versions"]])


def main() -> None:
    """Make the chunks that are missing, and the tables."""
    given = options(__doc__, steps=5_000_000, workers=1, folder=Path("runs/endurance"))
    rows = measured(given.folder / "endurance.jsonl", plan(given.steps), run, given.workers)
    keep("endurance", table(collected(rows)))


def used_mb() -> float:
    """Memory of this process, MB, without what is free in the allocator: MuJoCo's buffers leave holes of 10 MB."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2.0**20
