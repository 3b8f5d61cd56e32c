"""How a filter's cost grows: with discs, rows, constraints, the look-ahead, and envs; and its memory.

    python -m benchmarks.scaling     # three minutes; writes results/scaling.json, which docs/figures/scaling.py draws

Microseconds of one decision or projection, medians; of one env step where envs are counted. Memory is what a process
grows by, for each env.
"""

import gc
import json
import multiprocessing
import os
import resource
import statistics
import warnings
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import safe_wrappers as sw
from benchmarks import peers
from benchmarks.timing import paired_us

RESULT = Path(__file__).parent / "results" / "scaling.json"
STEPS, ENVS_KEPT = 400, 24
Curve = list[tuple[int, float]]


def decisions_us(env: sw.CBFActionFilter, share: float) -> float:
    """Median time of a decision about random actions of so much of their range."""
    rng, space, taken, over = np.random.default_rng(0), env.action_space, [], True
    assert isinstance(space, gym.spaces.Box)
    for _ in range(STEPS):
        if over:
            env.reset(seed=0)
        before = env.filter_seconds
        over = any(env.step((share * rng.uniform(space.low, space.high)).astype(space.dtype))[2:4])
        taken.append(1e6 * (env.filter_seconds - before))
    return statistics.median(taken)


def discs(count: int) -> float:
    """SafePointGoal among so many discs, full throttle at random."""
    env = gym.make("SafePointGoal0-v0")
    env.reset(seed=0)
    raw: Any = env.unwrapped
    rng = np.random.default_rng(0)
    angle, away = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(0.8, 3.0, count)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1) * away[:, None]
    raw.discs = raw.agent_position + around
    clearance = sw.constraints.HeadingDriveClearance([sw.constraints.Discs("discs", 0.1)])
    return decisions_us(sw.CBFActionFilter(env, [clearance]), share=1.0)


def rows(count: int) -> float:
    """`project` in two dimensions with so many rows, some of them violated."""
    items = peers.problems(2, count, active=True)
    return paired_us({"": peers.cycling(sw.project, items)}, rounds=20)[""]


def constraints(count: int) -> float:
    """A barrier so many times over, on the double integrator; half of the controls are changed."""
    env = peers.DoubleIntegrator()
    filtered = peers.wall_filter(env, count)

    def call(x: Any, u: Any) -> None:
        env.x = x
        filtered.step(u)

    return paired_us({"": peers.cycling(call, peers.states(True) + peers.states(False))}, batch=128)[""]


def look_ahead(steps: int) -> float:
    """A speed limit on HalfCheetah that looks so many control steps ahead, without a gate."""
    limit = sw.constraints.SpeedLimit(3.0, body="torso", horizon=steps)
    return decisions_us(sw.CBFActionFilter(gym.make("HalfCheetah-v5"), [limit]), share=0.2)


def envs(make: Callable[[], gym.Env[Any, Any]]) -> Callable[[int], float]:
    """One step of so many envs in one process, for each env."""

    def measure(count: int) -> float:
        vector = SyncVectorEnv([make] * count, autoreset_mode=AutoresetMode.NEXT_STEP)
        vector.reset(seed=0)
        vector.action_space.seed(0)
        actions = [vector.action_space.sample() for _ in range(64)]
        step = peers.cycling(lambda *action: vector.step(np.array(action)), actions)
        return paired_us({"": step}, batch=max(1, 256 // count), rounds=9)[""] / count

    return measure


def bare() -> gym.Env[Any, Any]:
    """SafePointGoal1 alone."""
    return gym.make("SafePointGoal1-v0")


def filtered() -> gym.Env[Any, Any]:
    """With `protect`."""
    return sw.protect(bare())


GROWTH: dict[str, tuple[Callable[[int], float], tuple[int, ...]]] = {
    "discs": (discs, (1, 4, 16, 64)),
    "rows": (rows, (1, 4, 16, 64)),
    "constraints": (constraints, (1, 2, 4, 8)),
    "look-ahead": (look_ahead, (1, 2, 5, 10, 20)),
    "envs, bare": (envs(bare), (1, 4, 16, 64)),
    "envs, filtered one by one": (envs(filtered), (1, 4, 16, 64)),
}
"""What grows: one time, at so many."""


def resident_kb() -> float:
    """Memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1024.0


def memory_kb(make: Callable[[], gym.Env[Any, Any]]) -> float:
    """What one more env takes, after its first step."""
    kept = []
    for i in range(2 * ENVS_KEPT):
        if i == ENVS_KEPT:
            gc.collect()
            before = resident_kb()
        kept.append(make())
        kept[-1].reset(seed=0)
        kept[-1].step(kept[-1].action_space.sample())
    gc.collect()
    return (resident_kb() - before) / ENVS_KEPT


def in_a_new_process(make: Callable[[], gym.Env[Any, Any]]) -> float:
    """`memory_kb` where nothing has been freed that could be used again."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(memory_kb, make).result()


def main() -> None:
    """Measure, print and write."""
    warnings.simplefilter("ignore")
    found: dict[str, Any] = {}
    print("| grows with | " + " | ".join(["us at"] * 5) + " |\n|---|" + "---|" * 5)
    for name, (measure, counts) in GROWTH.items():
        curve: Curve = [(count, round(measure(count), 2)) for count in counts]
        found[name] = curve
        cells = [f"{count}: {us:.3g}" for count, us in curve]
        print(f"| {name} | {' | '.join(cells + [''] * (5 - len(cells)))} |", flush=True)
    found["memory"] = {"env_kb": in_a_new_process(bare), "filtered_kb": in_a_new_process(filtered)}
    found["memory"]["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    kb = {name: round(value) for name, value in found["memory"].items()}
    found["memory"] = kb
    print(
        f"\nMemory of one more SafePointGoal1: {kb['env_kb']} kB, filtered {kb['filtered_kb']} kB; "
        f"of this process {kb['peak_mb']} MB at most."
    )
    RESULT.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
