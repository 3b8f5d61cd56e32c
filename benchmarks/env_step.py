"""What the filter adds to an env step: beside each filtered env runs one without that makes the same steps.

`bench` makes the rows of its table of these. Inactive: the filter admits the action (a slow driver). Active: it
projects it (a driver that goes for the limit; steps of the fallback are left out). The ratio is the median over steps
of the time with the filter over the time without. Runners that act at random are slower than their published limits,
so for them the limit of the active rows is lower; the filter's work is the same.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import SyncVectorEnv

import safe_wrappers as sw
from benchmarks import car_drivers, mujoco_drivers
from benchmarks.cases import PROTECTED
from benchmarks.drivers import DRIVERS, Driver, Maker

Filter = Callable[[gym.Env[Any, Any]], sw.CBFActionFilter]


def gentle(env: Any, rng: np.random.Generator) -> Driver:
    """Small pushes and turns: on no env does the filter need to act on these for long."""
    return lambda: 0.02 * rng.uniform(env.action_space.low, env.action_space.high)


def slower(limit: float) -> Filter:
    """`protect`'s constraint with a lower speed limit, m/s."""
    return lambda env: sw.CBFActionFilter(env, [replace(sw.protect(env).constraints[0], limit=limit)])


SEEKING = DRIVERS["hazard-seeking"]
ACTIVE: dict[str, tuple[Maker, Filter]] = {
    "SafePointGoal1-v0": (SEEKING, sw.protect),
    "SafePointGoal2-v0": (SEEKING, sw.protect),
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


def measure(
    name: str, driver: Maker, protect: Filter, active: bool, steps: int
) -> tuple[tuple[float, float], dict[str, float]]:
    """Step a filtered env and a bare one alike and time them.

    Args:
        name: Of a case of the protected envs.
        driver: Of the filtered env; the other one is given what was executed.
        protect: Puts the filter on.
        active: Look for steps that were projected, or for steps that were not changed.
        steps: In all.

    Returns:
        Microseconds of a step with the filter and the ratio to one without, medians over the steps that were looked
        for; of all steps, the share without an admissible action, and the mean length of what was changed in units
        of the action, NaN if nothing was.
    """
    case, clock = PROTECTED[name], time.perf_counter
    bare = case.make()
    env = protect(case.make())
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
        over = truncated or (terminated and not case.past_termination)
        infeasible += info["cbf/infeasible"]
        if info["cbf/intervened"]:
            corrections.append(info["cbf/correction"])
        if info["cbf/intervened"] == active and not info["cbf/fallback"]:
            times.append((1e6 * (between - begin), (between - begin) / (end - begin_bare)))
    with_us, ratio = np.median(np.reshape(times, (-1, 2)), axis=0)
    more = {"infeasible": infeasible / steps, "correction": float(np.mean(corrections))}
    return (float(with_us), float(ratio)), more


def measure_vector(n: int, drive: Maker, steps: int = 120, settle: int = 20) -> tuple[float, float]:
    """SafePointGoal1 in a SyncVectorEnv, with one filter around it and bare, making the same steps in turn.

    Returns:
        Microseconds per env and step with the filter, and the ratio to one without.
    """
    bare, filtered = (SyncVectorEnv([lambda: gym.make("SafePointGoal1-v0")] * n) for _ in range(2))
    together = sw.protect(filtered)
    bare.reset(seed=0)
    together.reset(seed=0)
    singles = [single.unwrapped for single in together.filters]
    drivers = [drive(env, np.random.default_rng(i)) for i, env in enumerate(singles)]
    times = []
    for step in range(steps):
        actions = np.array([act() for act in drivers], dtype=bare.single_action_space.dtype)
        began = time.perf_counter()
        infos = together.step(actions)[4]
        between = time.perf_counter()
        executed = infos["executed_action"].astype(actions.dtype)
        began_bare = time.perf_counter()
        bare.step(executed)
        end = time.perf_counter()
        if step >= settle:
            times.append((end - began_bare, (between - began) / (end - began_bare)))
    for envs in (bare, together):
        envs.close()
    alone, ratio = np.median(times, axis=0)
    return 1e6 * float(alone * ratio) / n, float(ratio)
