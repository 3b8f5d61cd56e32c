"""How long the proved filters hold against attackers: violations, lowest margins, memory and speed over many steps.

    python -m benchmarks endurance                    # 5,000,000 control steps; goes on where it was killed
    python -m benchmarks endurance --steps 20000000   # and farther

Chunks of one env, driver and seed are made one after the other in the same process, each a line in
`runs/endurance/endurance.jsonl`. The hand-written drivers attack 16 envs at once through a `VectorCBFActionFilter`.
CEM and differences search 30 steps ahead in copies of the env, filter included. The learner is PPO that is paid for
violations, anew in each chunk. Filters with a wrong plant are attacked on SafePointGoal by those written by hand: by
20 % in mass and in damping, all four corners, with 25 % of uncertainty declared (true is the plant's times 1 / 0.8).

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
from itertools import product, zip_longest
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
STEPS = {"hand": 50_000, "off": 5_000, "wrong": 5_000, "search": 1_000, LEARNER: 50_000}
"""Control steps of a chunk, by the kind of driver; `off` is a hand-written one without the filter, `wrong` with a
filter that has a wrong plant."""
WRONG = "wrong plant"
EXTRA = ("simulated", "simulated_violations", "off_steps", "off_violations")
"""Counts of a row beside its tally: of the steps that searches simulated, and of those without the filter."""
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
    mass: float = 1.0
    damping: float = 1.0


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
                    corners = product((0.8, 1.2), repeat=2) if "PointGoal" in env else ()
                    found += [Chunk(env, driver, STEPS["wrong"], 0, True, *wrong) for wrong in corners]
                found.append(Chunk(env, driver, STEPS[kind], seed))
                planned += STEPS[kind]
        seed += 1


def run(chunk: Chunk) -> dict[str, Any]:
    """Attack, judge and count; then look at the process."""
    warnings.simplefilter("ignore", UnsafeStateWarning)  # counted
    row = dict.fromkeys(EXTRA, 0) | (learn(chunk) if chunk.driver == LEARNER else attack(chunk))
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
    envs.close()
    if not chunk.filtered:
        return asdict(Tally()) | {"off_steps": tally.steps, "off_violations": tally.violations}
    return asdict(tally) | {name: sum(getattr(driver, name, 0) for driver in drivers) for name in EXTRA[:2]}


def attacked(chunk: Chunk) -> tuple[Any, list[Any]]:
    """The vector env of a chunk, reset, and the driver of each env; all of it follows from the seed."""
    case, search, wrong = CASES[chunk.env], SEARCHES.get(chunk.driver), is_wrong(chunk._asdict())

    def single() -> Any:
        if not wrong:
            return case.protect(case.make()) if search else case.make()
        plant = sw.MujocoPlant()
        plant.perturb(mass=chunk.mass, damping=chunk.damping)
        return sw.protect(case.make(), plant=plant, uncertainty=0.25)

    n = 1 if search or wrong else TOGETHER
    envs: Any = SyncVectorEnv([single] * n)
    if chunk.filtered and not (search or wrong):
        envs = sw.protect(envs)
    own = zlib.crc32(f"{chunk.env} {chunk.driver}".encode())  # no driver starts where another does
    seeds = [int(seed) for seed in np.random.SeedSequence([chunk.seed, own]).generate_state(2 * n)]
    envs.reset(seed=seeds[:n])
    rngs = map(np.random.default_rng, seeds[n:])
    if search:
        return envs, [SearchingDriver(env, rng, search) for env, rng in zip(envs.envs, rngs, strict=True)]
    make = hand_written(chunk.env)[chunk.driver]
    return envs, [make(env.unwrapped, rng) for env, rng in zip(envs.unwrapped.envs, rngs, strict=True)]


def is_wrong(row: dict[str, Any]) -> bool:
    """Whether the filter's plant was: nothing is proved there."""
    return bool(row["mass"] != 1.0 or row["damping"] != 1.0)


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


def memory(rows: list[dict[str, Any]], process: str) -> list[str]:
    """What the memory of one process did after its first round, by a line through the ends of its chunks.

    Counted are chunks of a kind that it has made before, over the filtered steps that it had made by then.
    """
    seen, warm, made = set(), [], 0
    for row in rows:
        if row["process"] == process:
            made += row["steps"]
            kind = tuple(row[name] for name in ("env", "driver", "filtered", "mass", "damping"))
            if kind in seen:
                warm.append((float(made), row["mb"]))
            seen.add(kind)
    if len(warm) < 3:
        return []
    steps, mb = np.array(warm).T
    span = steps[-1] - steps[0]
    growth = float(np.polyfit(steps, mb, 1)[0]) * span / float(mb.mean())
    return [
        f"Memory of a process after its first round, over {span:,.0f} steps in {len(warm)} chunks: "
        f"{mb.min():.0f} to {mb.max():.0f} MB; a line through them grows by {growth:.2%}."
    ]


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: a line per env and driver, one per env, and what memory did."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["env"], WRONG if is_wrong(row) else row["driver"]), []).append(row)
    lines, sums = [], []
    for (env, driver), part in sorted(groups.items(), key=lambda group: ENVS.index(group[0][0])):
        of = {name: total(part, name) for name in ("steps", "violations", *FLAGS, *EXTRA)}
        if not of["steps"]:
            continue
        off = f"{1e3 * of['off_violations'] / of['off_steps']:.0f}" if of["off_steps"] else "-"
        counts = [env, driver, f"{of['steps']:,}", f"{of['violations']:,}", off]
        flags = [f"{of['intervened'] / of['steps']:.1%}", *(f"{of[name]:,}" for name in FLAGS[1:])]
        lines.append([*counts, *flags, lowest_mm(part), f"{of['simulated']:,}" if of["simulated"] else "-"])
    right = [row for row in rows if row["steps"] and not is_wrong(row)]
    for env in [*dict.fromkeys(row["env"] for row in right), ""]:
        part = [row for row in right if env in ("", row["env"])]
        steps, bad = total(part, "steps"), total(part, "violations")
        bound = f"{3.0 / steps:.1e} a step" if not bad else "-"
        sums.append([env or "all", f"{steps:,}", f"{bad:,}", bound, lowest_mm(part)])
    head = (
        "env | driver | steps | violations | without the filter, of 1,000 | changed | infeasible | fallback"
    )
    by_driver = markdown(f"{head} | unsafe | lowest h (mm) | simulated steps", lines)
    by_env = markdown("env | steps | violations | at most, at 95 % | lowest h (mm)", sums)
    simulated, bad = total(rows, "simulated"), total(rows, "simulated_violations")
    said = [f"Of {simulated:,} steps that searches simulated, {bad:,} were in violation.", ""]
    for process in dict.fromkeys(row["process"] for row in rows):
        said += memory(rows, process)
    versions = sorted({row["versions"] for row in rows})
    return "\n".join([by_driver, "", by_env, "", *said, "", *versions])


def lowest_mm(rows: list[dict[str, Any]]) -> str:
    """The least h of any step's start."""
    return f"{1e3 * min(row['smallest'] for row in rows if row['smallest'] is not None):.3f}"


def main() -> None:
    """Make the chunks that are missing, and the tables."""
    given = options(__doc__, steps=5_000_000, workers=1, folder=Path("runs/endurance"))
    rows = measured(given.folder / "endurance.jsonl", plan(given.steps), run, given.workers)
    keep("endurance", table(rows))


def used_mb() -> float:
    """Memory of this process, MB, without what is free in the allocator: MuJoCo's buffers leave holes of 10 MB."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2.0**20
