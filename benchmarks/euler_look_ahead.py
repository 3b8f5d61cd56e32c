"""What a look-ahead by Euler steps changes on robots whose own steps are Runge-Kutta's.

    python -m benchmarks.euler_look_ahead            # writes results/euler_look_ahead.md
    python -m benchmarks.euler_look_ahead Ant Hopper

Two closed loops under the same driver, one with `SpeedLimit.euler_look_ahead`. A violation is a step faster than the
limit by the env's own truth; unflagged is one that the filter reported neither as infeasible nor as a fallback.
"""

import dataclasses
import sys
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import safe_wrappers as sw
from benchmarks import mujoco_drivers as drivers
from benchmarks.judges import faster_than
from benchmarks.mujoco_drivers import Maker
from safe_wrappers.errors import UnsafeStateWarning

RESULT = Path(__file__).parent / "results" / "euler_look_ahead.md"
LIMITS = {"Hopper": 0.3, "Walker2d": 0.5, "Swimmer": 0.1, "Ant": 0.3, "Humanoid": 0.2}
"""Beside the task's own limit: so low, m/s, that robots that act at random reach it."""
STEPS, SEEDS = 400, (1, 2, 3)
HEAD = """# A look-ahead by Euler steps

`python -m benchmarks.euler_look_ahead`. Closed loops on `Safe<Robot>Velocity-v0`, the look-ahead by the model's own
steps / by Euler steps. Corrections are means over the changed steps that are feasible.

| robot | limit, m/s | driver | steps | changed | infeasible | violations | unflagged | correction |
|---|---|---|---|---|---|---|---|---|
"""


def measure(robot: str, limit: float | None, make: Maker, euler: bool) -> tuple[int, int, int, int, float]:
    """Changed, infeasible, violating and unflagged steps, and the mean correction, over all seeds."""
    base = gym.make(f"Safe{robot}Velocity-v0")
    (speed,) = sw.protect(base).constraints
    assert isinstance(speed, sw.constraints.SpeedLimit)
    speed = dataclasses.replace(speed, limit=limit or speed.limit, euler_look_ahead=euler)
    missed = faster_than(speed.limit, robot in ("Ant", "Humanoid"))
    count, corrections = np.zeros(4, int), []
    for seed in SEEDS:
        env = sw.CBFActionFilter(gym.make(f"Safe{robot}Velocity-v0"), [speed])
        act, over, episode = make(env.unwrapped, np.random.default_rng(seed)), True, 100 * seed
        for _ in range(STEPS):
            if over:
                episode += 1
                env.reset(seed=episode)
            _, _, terminated, truncated, info = env.step(np.asarray(act(), env.action_space.dtype))
            over, violated = terminated or truncated, not missed(info) <= 0.0
            flagged = info["cbf/infeasible"] or info["cbf/fallback"] or info["cbf/unsafe"]
            count += [info["cbf/intervened"], info["cbf/infeasible"], violated, violated and not flagged]
            if info["cbf/intervened"] and not info["cbf/infeasible"]:
                corrections.append(info["cbf/correction"])
    changed, infeasible, violations, unflagged = count.tolist()
    return changed, infeasible, violations, unflagged, float(np.mean(corrections or [0.0]))


def line(robot: str, limit: float | None, name: str, make: Maker) -> str:
    """One line of the table."""
    own, euler = (measure(robot, limit, make, option) for option in (False, True))
    cells: list[Any] = [f"{a} / {b}" for a, b in zip(own[:4], euler[:4], strict=True)]
    shown = "the task's" if limit is None else f"{limit}"
    cells = [robot, shown, name, STEPS * len(SEEDS), *cells, f"{own[4]:.3f} / {euler[4]:.3f}"]
    return "| " + " | ".join(map(str, cells)) + " |"


def main() -> None:
    """Measure, print, and write the table if all robots were asked for."""
    warnings.simplefilter("ignore", UnsafeStateWarning)
    chosen = [robot for robot in LIMITS if not sys.argv[1:] or robot in sys.argv[1:]]
    lines = []
    for robot in chosen:
        sprinting = drivers.sprinting if robot in ("Ant", "Humanoid") else drivers.sprinting_along_x
        for limit, name, make in (
            (None, "corners, 20 steps", drivers.corners(20)),
            (None, "planned sprint", sprinting),
            (LIMITS[robot], "corners, 15 steps", drivers.pulse),
        ):
            lines.append(line(robot, limit, name, make))
            print(lines[-1], flush=True)
    if chosen == list(LIMITS):
        RESULT.write_text(HEAD + "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
