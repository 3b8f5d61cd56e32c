"""What it costs to look, to estimate and to keep a way out clear, in microseconds per control step.

    python -m benchmarks.occlusion_cost

OcclusionPenalty around OccludedCrossing, 1, 4 and 16 points over the road tracked, beside the bare env in one run.
Rays: all of a step in one call, beside one call for each, from the same eye to the same points. EscapeClearance:
steps of `protect` around OcclusionPenalty beside steps without the filter that are given what was executed; medians
of the steps that it changed and of those that it did not.
"""

import time
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

import safe_wrappers as sw
from benchmarks.crossing_drivers import DRIVERS
from benchmarks.timing import paired_us, stepping
from benchmarks.tracked import CROSSING, crossing
from safe_wrappers.plants.queries.line_of_sight import LineOfSight

ENV_ID = "OccludedCrossing-v0"
COUNTS = (1, 4, 16)


def make(count: int) -> sw.OcclusionPenalty:
    """The crossing with so many points over the road tracked instead of its cars."""
    env = gym.make(ENV_ID)
    env.unwrapped.points = spread(count)  # type: ignore[attr-defined]
    track = sw.occlusion.Track(published="points", acceleration_noise=0.0225, reversion_s=2.0)
    return sw.OcclusionPenalty(
        env, [track], CROSSING["sensor"] | {"view_deg": 360}, tolerance=0.5, weight=0.05
    )


def spread(count: int) -> NDArray[np.float64]:
    """Points on the road, shape (count, 2), m."""
    return np.stack([np.linspace(-3.5, 3.5, count), 0.8 * (-1.0) ** np.arange(count)], axis=1)


def tracking_us(rounds: int = 40, batch: int = 50) -> dict[str, float]:
    """Step of the bare env and with so many tracks."""
    sides = {"bare": stepping(gym.make(ENV_ID))}
    sides |= {f"{count} tracks": stepping(make(count)) for count in COUNTS}
    return paired_us(sides, batch, rounds)


def rays(count: int) -> dict[str, Callable[[], NDArray[np.bool_]]]:
    """To the points: all in one call, and one by one."""
    env = gym.make(ENV_ID)
    raw: Any = env.unwrapped
    env.reset(seed=0)
    sight = LineOfSight(raw.model, "eye", None, 360.0, np.inf, None)
    sight.read(raw.data)
    eye, body = sight.position, sight.body
    points = np.column_stack([spread(count), np.full(count, eye[2])])
    nothing, hit = np.full(count, -1, dtype=np.intp), np.zeros(1, dtype=np.int32)

    def singly() -> NDArray[np.bool_]:
        seen = np.empty(count, dtype=bool)
        for i, point in enumerate(points):
            way = point - eye
            distance = float(np.sqrt(way @ way))
            met = mujoco.mj_ray(raw.model, raw.data, eye, way / distance, None, 1, body, hit)
            seen[i] = met < 0.0 or met >= distance
        return seen

    return {"one call": lambda: sight.sees(points, nothing), "singly": singly}


def filter_us(steps: int) -> dict[str, tuple[int, float, float]]:
    """Steps not changed and steps changed: how many, their median without the filter and with it."""
    env, bare = sw.protect(crossing(gym.make(ENV_ID))), crossing(gym.make(ENV_ID))
    act = DRIVERS["pulse"](env.unwrapped, np.random.default_rng(0))
    kind: Any = env.action_space.dtype
    times: dict[str, list[tuple[float, float]]] = {"inactive": [], "active": []}
    over, seed = True, 0
    for _ in range(steps):
        if over:
            env.reset(seed=seed)
            bare.reset(seed=seed)
            seed += 1
        action = np.asarray(act(), dtype=kind)
        begin = time.perf_counter()
        _, _, _, over, info = env.step(action)
        between = time.perf_counter()
        executed = info["executed_action"].astype(kind)
        begin_bare = time.perf_counter()
        bare.step(executed)
        end = time.perf_counter()
        which = "active" if info["cbf/intervened"] else "inactive"
        times[which].append((end - begin_bare, between - begin))
    found = {}
    for which, pairs in times.items():
        without, with_it = 1e6 * np.median(np.array(pairs), axis=0)
        found[which] = (len(pairs), float(without), float(with_it))
    return found


def main() -> None:
    """Print the tables."""
    warnings.simplefilter("ignore")
    us = tracking_us()
    print("| OccludedCrossing | step (us) | added (us) |\n|---|---|---|")
    for name, value in us.items():
        print(f"| {name} | {value:.0f} | {value - us['bare']:.0f} |", flush=True)
    print("\n| rays | one call (us) | one by one (us) |\n|---|---|---|")
    for count in COUNTS:
        both = paired_us(rays(count))
        print(f"| {count} | {both['one call']:.1f} | {both['singly']:.1f} |", flush=True)
    print(
        "\n| EscapeClearance, 6 cars | steps | without (us) | with it (us) | added (us) |\n|---|---|---|---|---|"
    )
    for which, (steps, without, with_it) in filter_us(3000).items():
        print(f"| {which} | {steps:,} | {without:.0f} | {with_it:.0f} | {with_it - without:.0f} |")


if __name__ == "__main__":
    main()
