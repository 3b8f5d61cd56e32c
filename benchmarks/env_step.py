"""What the filter adds to an env step: SafePointGoal1 and 2, Reacher, InvertedPendulum, paired in one run.

python -m benchmarks.env_step

Inactive: the policy's action is admitted (a slow driver that the filter never has to change, where that
exists). Active: it is changed at nearly every step (a hazard-seeking driver, or full throttle).
"""

import statistics
import time
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

import safe_wrappers as sw
from benchmarks.drivers import towards

Policy = Callable[[Any, int], np.ndarray]


def gentle(env: Any, step: int) -> np.ndarray:
    """Small pushes and turns: on no env does the filter need to act on these for long."""
    rng = np.random.default_rng(step)
    return rng.uniform(-0.02, 0.02, env.action_space.shape)


def towards_a_hazard(env: Any, step: int) -> np.ndarray:
    """Drive into the nearest hazard."""
    hazards = env.hazard_positions
    near = np.linalg.norm(hazards - env.agent_position, axis=1).argmin()
    return towards(env, hazards[near])


def full_throttle(env: Any, step: int) -> np.ndarray:
    """The action space's upper corner."""
    return np.asarray(env.action_space.high, dtype=np.float64)


CASES: tuple[tuple[str, str, Policy], ...] = (
    ("SafePointGoal1-v0", "inactive", gentle),
    ("SafePointGoal1-v0", "active", towards_a_hazard),
    ("SafePointGoal2-v0", "inactive", gentle),
    ("SafePointGoal2-v0", "active", towards_a_hazard),
    ("Reacher-v5", "inactive", gentle),
    ("Reacher-v5", "active", full_throttle),
    ("InvertedPendulum-v5", "inactive", gentle),
    ("InvertedPendulum-v5", "active", full_throttle),
)


def measure(env_id: str, policy: Policy, rounds: int = 30, batch: int = 100) -> tuple[float, float, float]:
    """Median microseconds per step without and with the filter, and the share of steps it changed."""
    bare, filtered = gym.make(env_id), sw.protect(gym.make(env_id))
    times: dict[Any, list[float]] = {bare: [], filtered: []}
    changed = steps = 0
    for seed in range(rounds):
        for env in (bare, filtered):
            env.reset(seed=seed)
            spent = 0.0
            for step in range(batch):
                action = policy(env.unwrapped, step)
                start = time.perf_counter()
                _, _, terminated, truncated, info = env.step(action)
                spent += time.perf_counter() - start
                if env is filtered:
                    changed += int(info["cbf/intervened"])
                    steps += 1
                if terminated or truncated:
                    env.reset()
            times[env].append(spent / batch * 1e6)
    return statistics.median(times[bare]), statistics.median(times[filtered]), changed / steps


def main() -> None:
    """Print the table."""
    warnings.simplefilter("ignore")
    print("| env | driver | changed | step (us) | with filter (us) | ratio |\n|---|---|---|---|---|---|")
    for env_id, name, policy in CASES:
        bare, filtered, changed = measure(env_id, policy)
        print(f"| {env_id} | {name} | {changed:.0%} | {bare:.0f} | {filtered:.0f} | {filtered / bare:.2f} |")


if __name__ == "__main__":
    main()
