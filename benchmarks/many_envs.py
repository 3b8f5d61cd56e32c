"""What one filter for a whole vector env costs, by the number of envs.

    python -m benchmarks.many_envs

SafePointGoal1 in a SyncVectorEnv: bare, with `VectorCBFActionFilter` around it, and with a filter in each env. All
three make the same steps in turn, so that the ratios are those of one process. A slow driver needs no change, one
that goes for the nearest hazard many.
"""

import resource
import sys
import time
import warnings
from collections.abc import Sequence

import gymnasium as gym
import numpy as np
from gymnasium.vector import SyncVectorEnv

import safe_wrappers as sw
from benchmarks.drivers import DRIVERS
from benchmarks.env_step import gentle

ENV = "SafePointGoal1-v0"
DRIVEN = ("gentle", "hazard-seeking")
NUMBERS = (1, 4, 16, 64, 256, 1024)


def measure(n: int, driver: str, steps: int = 120, settle: int = 20) -> tuple[float, ...]:
    """Microseconds per env and step bare; the two ratios to that; the share of changed steps."""

    def make() -> gym.Env[np.ndarray, np.ndarray]:
        return gym.make(ENV)

    bare = SyncVectorEnv([make] * n)
    together = sw.protect(SyncVectorEnv([make] * n))
    each = SyncVectorEnv([lambda: sw.protect(make())] * n)
    sides = (bare, together, each)
    for envs in sides:
        envs.reset(seed=0)
    singles = [single.unwrapped for single in together.filters]
    drive = DRIVERS["hazard-seeking"] if driver == "hazard-seeking" else gentle
    drivers = [drive(env, np.random.default_rng(i)) for i, env in enumerate(singles)]
    times, changed = [], []
    for step in range(steps):
        actions = np.array([act() for act in drivers], dtype=bare.single_action_space.dtype)
        taken = []
        for envs in (together, each, bare):
            started = time.perf_counter()
            infos = envs.step(actions)[4]
            taken.append(time.perf_counter() - started)
            if envs is together:
                changed.append(infos["cbf/intervened"].mean())
                executed = infos["executed_action"].astype(actions.dtype)
            elif envs is each:
                actions = executed
        if step >= settle:
            times.append((taken[2], taken[0] / taken[2], taken[1] / taken[2]))
    for envs in sides:
        envs.close()
    return (*np.median(times, axis=0) * [1e6 / n, 1.0, 1.0], float(np.mean(changed[settle:])))


def main(numbers: Sequence[int] = NUMBERS) -> None:
    """Print the table."""
    warnings.simplefilter("ignore")
    print(
        "| envs | driver | changed | bare (us per env) | one filter for all | a filter in each | memory (MB) |"
    )
    print("|---|---|---|---|---|---|---|")
    for n in numbers:
        for driver in DRIVEN:
            bare, together, each, changed = measure(n, driver)
            memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            print(
                f"| {n:,} | {driver} | {changed:.0%} | {bare:.0f} | {together:.2f} | {each:.2f} | {memory:.0f} |"
            )


if __name__ == "__main__":
    main([int(n) for n in sys.argv[1:]] or NUMBERS)
