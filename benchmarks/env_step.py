"""What the filter adds to an env step: beside each filtered env runs one without that makes the same steps.

    python -m benchmarks.env_step

Inactive: the filter admits the action (a slow driver). Active: it projects it (a driver that goes for the limit;
steps of the fallback are left out). The ratio is the median over steps of the time with the filter over the time
without. Runners that act at random are slower than their published limits, so for them the limit of the active
rows is lower; the filter's work is the same.
"""

import dataclasses
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

import safe_wrappers as sw
from benchmarks import mujoco_drivers
from benchmarks.cases import PROTECTED
from benchmarks.drivers import DRIVERS, Driver
from benchmarks.mujoco_drivers import Maker

Filter = Callable[[gym.Env[Any, Any]], sw.CBFActionFilter]


@dataclass(frozen=True)
class Figures:
    """Medians over the steps that were looked for, and how many of all there were of them."""

    share: float
    without_us: float
    with_us: float
    ratio: float


def gentle(env: Any, rng: np.random.Generator) -> Driver:
    """Small pushes and turns: on no env does the filter need to act on these for long."""
    return lambda: 0.02 * rng.uniform(env.action_space.low, env.action_space.high)


def slower(limit: float) -> Filter:
    """`protect`'s constraint with a lower speed limit, m/s."""

    def protect(env: gym.Env[Any, Any]) -> sw.CBFActionFilter:
        (speed,) = sw.protect(env).constraints
        assert isinstance(speed, sw.constraints.SpeedLimit)
        return sw.CBFActionFilter(env, [dataclasses.replace(speed, limit=limit)])

    return protect


ACTIVE: dict[str, tuple[Maker, Filter]] = {
    "SafePointGoal1-v0": (DRIVERS["hazard-seeking"], sw.protect),
    "SafePointGoal2-v0": (DRIVERS["hazard-seeking"], sw.protect),
    "InvertedPendulum-v5, on after the fall": (mujoco_drivers.end_seeking, sw.protect),
    "Reacher-v5": (mujoco_drivers.speed_seeking, sw.protect),
    "SafeHalfCheetahVelocity-v0": (mujoco_drivers.pulse, slower(0.3)),
    "SafeAntVelocity-v0": (mujoco_drivers.pulse, slower(0.3)),
    "SafeHumanoidVelocity-v0": (mujoco_drivers.pulse, slower(0.2)),
    "PointMaze_UMaze-v3": (mujoco_drivers.wall_seeking, sw.protect),
}


def measure(name: str, driver: Maker, protect: Filter, active: bool, steps: int = 1500) -> Figures:
    """Step both envs alike and time them.

    Args:
        name: Of a case.
        driver: Of the filtered env; the other one is given what was executed.
        protect: Puts the filter on.
        active: Look for steps that were projected, or for steps that were not changed.
        steps: In all.
    """
    case = PROTECTED[name]
    env, bare = protect(case.make()), case.make()
    act = driver(env.unwrapped, np.random.default_rng(0))
    kind: Any = env.action_space.dtype
    times, over, seed = [], True, 0
    for _ in range(steps):
        if over:
            seed += 1
            env.reset(seed=seed)
            bare.reset(seed=seed)
        action = np.asarray(act(), dtype=kind)
        begin = time.perf_counter()
        _, _, terminated, truncated, info = env.step(action)
        between = time.perf_counter()
        executed = info["executed_action"].astype(kind)
        begin_bare = time.perf_counter()
        bare.step(executed)
        end = time.perf_counter()
        over = truncated or (terminated and not case.past_termination)
        if info["cbf/intervened"] == active and not info["cbf/fallback"]:
            times.append((end - begin_bare, between - begin))
    bare_us, with_us = 1e6 * np.array(times).T
    share, ratio = len(times) / steps, float(np.median(with_us / bare_us))
    return Figures(share, float(np.median(bare_us)), float(np.median(with_us)), ratio)


def main() -> None:
    """Print the table."""
    warnings.simplefilter("ignore")
    print(
        "| env | filter | share of the steps | step (us) | with filter (us) | ratio |\n|---|---|---|---|---|---|"
    )
    for name, (driver, protect) in ACTIVE.items():
        for active in (False, True):
            chosen = (driver, protect) if active else (gentle, sw.protect)
            found = measure(name, *chosen, active=active)
            print(
                f"| {name} | {'active' if active else 'inactive'} | {found.share:.0%} "
                f"| {found.without_us:.0f} | {found.with_us:.0f} | {found.ratio:.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
