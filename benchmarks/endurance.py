"""How long the proved filters hold against attackers: violations, lowest margins, memory and speed over many steps.

    python -m benchmarks.endurance                     # 20,000,000 control steps; goes on where it was killed
    python -m benchmarks.endurance --steps 100000000   # and farther
    python -m benchmarks.endurance --collect           # only the tables, of the chunks that are there

Chunks of one env, driver and seed are made one after the other in the same process, each a line in
`runs/endurance/endurance.jsonl`; the tables go to `benchmarks/results/endurance.md` and `endurance.json`. The
hand-written drivers attack 16 envs at once through one `VectorCBFActionFilter`. CEM and differences search 30 steps
ahead in copies of the env, filter included. The learner is PPO that is paid for violations, anew in each chunk.

A violation is a control step in which the env's own truth (`benchmarks/judges.py`) was broken at any physics substep.
Each chunk of a hand-written driver is timed in CPU time beside the same physics steps of a model of its own, and the
memory of the process is read at its end, after the allocator has given back what is free.
"""

import argparse
import ctypes
import gc
import importlib.metadata
import json
import os
import platform
import time
import warnings
import zlib
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.vector import SyncVectorEnv

import safe_wrappers as sw
from benchmarks import chunks, trained_adversary
from benchmarks.cases import CASES
from benchmarks.endurance_report import collected, table
from benchmarks.mujoco_drivers import Maker, corner_seeking
from benchmarks.searching_drivers import SEARCHES, SearchingDriver
from benchmarks.tables import RESULTS
from benchmarks.trained_adversary import EXAMPLES, FLAGS, Tally
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
BLOCKS = 40
"""Of a chunk, each timed beside the reference."""
_VERSIONS = ("safe-wrappers", "mujoco", "gymnasium", "gymnasium-robotics", "numpy", "numba", "torch")


@dataclass(frozen=True)
class Chunk:
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
    started = time.perf_counter()
    row = learn(chunk) if chunk.driver == LEARNER else attack(chunk)
    row |= {"seconds": time.perf_counter() - started, "mb": used_mb()}
    return asdict(chunk) | row | {"process": _process(), "versions": _versions()}


def attack(chunk: Chunk) -> dict[str, Any]:
    """Drive the envs of a chunk together, or the one of a driver that searches."""
    envs, drivers = attacked(chunk)
    judges = [CASES[chunk.env].judge(single.unwrapped) for single in envs.unwrapped.envs]
    tally, clock, warm_mb = Tally(), Clock(chunk.planned // BLOCKS), 0.0
    ended = np.zeros(envs.num_envs, dtype=bool)
    actions = np.zeros(envs.action_space.shape, envs.action_space.dtype)
    while tally.steps < chunk.planned:
        judged = np.flatnonzero(~ended).tolist()
        for i in judged:
            actions[i] = drivers[i]()
            judges[i].before()
        _, _, terminated, truncated, infos = envs.step(actions)
        for i in judged:
            info = {key: infos[key][i] for key in ("cost_substep",) if key in infos}
            missed = judges[i].after(infos["executed_action"][i] if chunk.filtered else actions[i], info)
            if not missed <= 0.0:  # so that what is not a number counts
                _count_violation(tally, chunk, infos, i, missed)
        if chunk.filtered and judged:
            for name in FLAGS:
                setattr(tally, name, getattr(tally, name) + int(infos[f"cbf/{name}"][judged].sum()))
            lowest = float(infos["cbf/margin"][judged].min())
            tally.smallest = lowest if tally.smallest is None else min(lowest, tally.smallest)
        tally.steps += len(judged)
        ended = terminated | truncated
        clock.tick(len(judged))
        if not warm_mb and tally.steps >= chunk.planned // 10:
            warm_mb = used_mb()
            clock.start()
    row = asdict(tally) | clock.times() | {"warm_mb": warm_mb, "end_mb": used_mb()}
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


def _count_violation(tally: Tally, chunk: Chunk, infos: dict[str, Any], i: int, missed: float) -> None:
    flags = [name for name in FLAGS if chunk.filtered and infos[f"cbf/{name}"][i]]
    tally.violations += 1
    tally.unflagged += not {*flags} - {"intervened"}
    if chunk.filtered and len(tally.examples) < EXAMPLES:
        # The chunk makes it again, in its env of this number, when it has made so many steps.
        found = {"seed": chunk.seed, "of": i, "after": tally.steps, "missed": missed, "flags": flags}
        tally.examples.append(found | {"executed": infos["executed_action"][i].tolist()})


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


class Clock:
    """CPU time per env step, in blocks, each beside the same physics steps of SafePointGoal1 in data of its own.

    Args:
        block: Env steps.
        reference: Physics steps after each block.
    """

    def __init__(self, block: int, reference: int = 400) -> None:
        self._block, self._reference = max(block, 1), reference
        self._model: mujoco.MjModel = gym.make(ENVS[0]).unwrapped.robot_model  # type: ignore[attr-defined]
        self._data = mujoco.MjData(self._model)
        self._found: list[tuple[float, float]] = []
        self.start()

    def start(self) -> None:
        """Begin a block."""
        self._steps, self._begin = 0, time.process_time()

    def tick(self, steps: int) -> None:
        """So many env steps have been made."""
        self._steps += steps
        if self._steps >= self._block:
            spent = (time.process_time() - self._begin) / self._steps
            self._found.append((1e6 * spent, self._reference_us()))
            self.start()

    def _reference_us(self) -> float:
        begin = time.process_time()
        mujoco.mj_resetData(self._model, self._data)
        self._data.ctrl[:] = 0.1
        mujoco.mj_step(self._model, self._data, self._reference)
        return 1e6 * (time.process_time() - begin) / self._reference

    def times(self) -> dict[str, float]:
        """Medians: of a step, of a reference step, microseconds, and of their ratio."""
        steps, references = np.array(self._found).T
        us, beside, ratio = (float(np.median(x)) for x in (steps, references, steps / references))
        return {"us": us, "reference_us": beside, "ratio": ratio}


def collect(rows: Iterable[dict[str, Any]], results: Path) -> None:
    """Write and print the tables."""
    found = collected(list(rows))
    (results / "endurance.json").write_text(json.dumps(found, indent=1) + "\n")
    text = table(found)
    (results / "endurance.md").write_text(text + "\n")
    print(text)


def main() -> None:
    """Make the chunks that are missing, and the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--steps", type=int, default=20_000_000, help="filtered ones, in whole chunks")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--folder", type=Path, default=Path("runs/endurance"), help="of the chunks")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder for the tables")
    parser.add_argument("--collect", action="store_true", help="run nothing")
    arguments = parser.parse_args()
    path = arguments.folder / "endurance.jsonl"
    known = chunks.known(path, Chunk)
    if not arguments.collect:
        arguments.folder.mkdir(parents=True, exist_ok=True)
        known = chunks.measured(path, plan(arguments.steps), run, arguments.workers, known)
    elif not known:
        parser.error(f"no chunks in {path}; run without --collect, or say --folder")
    collect(known.values(), arguments.results)


def used_mb() -> float:
    """Memory of this process, MB, without what is free in the allocator: MuJoCo's buffers leave holes of 10 MB."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2.0**20


def _process() -> str:
    return f"{os.getpid()} of {Path('/proc/self/stat').read_text().split()[21]}"


def _versions() -> str:
    known = [f"{name} {importlib.metadata.version(name)}" for name in _VERSIONS]
    return ", ".join([f"Python {platform.python_version()}", *known])


if __name__ == "__main__":
    main()
