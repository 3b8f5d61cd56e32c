"""What the filter adds to an env step: beside each filtered env runs one without that makes the same steps.

`bench` makes the rows of its table of these. Inactive: the filter admits the action (a slow driver). Active: it
projects it (a driver that goes for the limit; steps of the fallback are left out). The ratio is the median over steps
of the time with the filter over the time without. Runners that act at random are slower than their published limits,
so for them the limit of the active rows is lower; the filter's work is the same.
"""

import dataclasses
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

import safe_wrappers as sw
from benchmarks import car_drivers, mujoco_drivers
from benchmarks.cases import PROTECTED
from benchmarks.drivers import DRIVERS, Driver
from benchmarks.mujoco_drivers import Maker

Filter = Callable[[gym.Env[Any, Any]], sw.CBFActionFilter]


@dataclass(frozen=True)
class Figures:
    """Medians over the steps that were looked for.

    Attributes:
        share: Of all steps, those that were looked for.
        infeasible: Of all steps, those without an admissible action.
        correction: Mean length of what was changed, in units of the action; NaN if nothing was.
        without_us: Of the env's step alone.
        with_us: Of the step with the filter.
        ratio: Median of the steps' ratios.
    """

    share: float
    infeasible: float
    correction: float
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
    "SafeCarGoal1-v0": (car_drivers.DRIVERS["full throttle"], sw.protect),
    "InvertedPendulum-v5, on after the fall": (mujoco_drivers.end_seeking, sw.protect),
    "Reacher-v5": (mujoco_drivers.speed_seeking, sw.protect),
    "SafeHalfCheetahVelocity-v0": (mujoco_drivers.pulse, slower(0.3)),
    "SafeAntVelocity-v0": (mujoco_drivers.pulse, slower(0.3)),
    "SafeHopperVelocity-v0": (mujoco_drivers.pulse, slower(0.2)),
    "SafeSwimmerVelocity-v0": (mujoco_drivers.pulse, slower(0.05)),
    "SafeHumanoidVelocity-v0": (mujoco_drivers.pulse, slower(0.2)),
    "PointMaze_UMaze-v3": (mujoco_drivers.wall_seeking, sw.protect),
    "FetchReach-v4": (PROTECTED["FetchReach-v4"].drivers["corner-seeking"], sw.protect),
}


def measure(name: str, driver: Maker, protect: Filter, active: bool, steps: int = 1500) -> Figures:
    """`compare` on a case of the protected envs."""
    case = PROTECTED[name]
    return compare(case.make, protect, driver, active, steps, time.perf_counter, case.past_termination)


def compare(
    make: Callable[[], gym.Env[Any, Any]],
    protect: Filter,
    driver: Maker,
    active: bool,
    steps: int,
    clock: Callable[[], float],
    past_termination: bool = False,
) -> Figures:
    """Step a filtered env and a bare one alike and time them.

    Args:
        make: Makes either env, without the filter.
        protect: Puts the filter on.
        driver: Of the filtered env; the other one is given what was executed.
        active: Look for steps that were projected, or for steps that were not changed.
        steps: In all.
        clock: What time is taken of, s.
        past_termination: Step on where the env ends.
    """
    bare = make()
    env = protect(make())
    act = driver(env.unwrapped, np.random.default_rng(0))
    kind: Any = env.action_space.dtype
    times, corrections, infeasible, over, seed = [], [], 0, True, 0
    for _ in range(steps):
        if over:
            seed += 1
            env.reset(seed=seed)
            bare.reset(seed=seed)
        action = np.asarray(act(), dtype=kind)
        begin = clock()
        _, _, terminated, truncated, info = env.step(action)
        between = clock()
        executed = info["executed_action"].astype(kind)
        begin_bare = clock()
        bare.step(executed)
        end = clock()
        over = truncated or (terminated and not past_termination)
        infeasible += info["cbf/infeasible"]
        if info["cbf/intervened"]:
            corrections.append(info["cbf/correction"])
        if info["cbf/intervened"] == active and not info["cbf/fallback"]:
            times.append((end - begin_bare, between - begin))
    correction = float(np.mean(corrections)) if corrections else math.nan
    shares = len(times) / steps, infeasible / steps
    if not times:
        return Figures(*shares, correction, math.nan, math.nan, math.nan)
    bare_us, with_us = 1e6 * np.array(times).T
    ratio = float(np.median(with_us / bare_us))
    return Figures(*shares, correction, float(np.median(bare_us)), float(np.median(with_us)), ratio)
