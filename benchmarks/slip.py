"""SafeRover's wheels under hard drivers, with the slip limiter on and off.

    python -m benchmarks slip    # 3 drivers, 200,000 steps each with and without; --steps 2000: a look

Drivers: full throttle, panic brake, and pulses. Grounds: a base of dry, wet or ice, by turns, with patches of water
and ice. The judge is the env's own: a step counts as slipping if any loaded wheel's slip was above 0.2 in size at the
end of any physics substep, as a spin-out above 0.5, as a yaw excursion if the yaw rate was more than 0.5 rad/s off
what speed and steering ask for.
"""

import itertools
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

import safe_wrappers as sw
from benchmarks.tables import CORES, keep, made, markdown, options, total

SLIPPING, YAW_EXCURSION = 0.2, 0.5
EPISODE_STEPS = 300
"""Three seconds: under full throttle the rover is out of the field soon after."""
GROUNDS = ("dry", "wet", "ice")
DRIVERS = ("full throttle", "panic brake", "pulse")
STANDSTILL = 0.05
"""m/s."""
PARTS = 4


class Job(NamedTuple):
    """One driver for so many steps."""

    driver: str
    limited: bool
    steps: int
    seed: int


def driven(name: str, raw: Any, rng: np.random.Generator) -> Iterator[Any]:
    """One episode's driver: torques and steering of each control step, shape (5,)."""
    period, size = rng.uniform(0.4, 2.0), rng.uniform(0.0, 1.0)
    torque, until, braking = np.ones(4), 0, False
    if name == "panic brake":
        top = rng.uniform(1.0, 5.0)
    for step in itertools.count():
        if name == "panic brake":
            if raw.forward_speed > top:
                braking = True
            elif braking and raw.forward_speed < STANDSTILL:
                braking, top = False, rng.uniform(1.0, 5.0)
            torque = np.full(1, -1.0 if braking else 1.0)
        if name == "pulse" and step >= until:
            until = step + int(rng.integers(3, 50))
            torque = rng.choice([-1.0, 0.0, 1.0], size=4 if rng.random() < 0.3 else 1)
        steering = size * math.sin(math.tau * 0.01 * step / period)
        yield np.array([*np.broadcast_to(torque, 4), steering], dtype=np.float32)


def run(job: Job) -> dict[str, Any]:
    """Drive, count."""
    env: Any = gym.make("SafeRover-v0", max_episode_steps=EPISODE_STEPS)
    raw = env.unwrapped
    if job.limited:
        env = sw.SlipLimiter(env, wheels=raw.wheels)
    rng = np.random.default_rng(job.seed)
    count = dict.fromkeys(("slipping", "spin_out", "spin_outs_begun", "yaw", "intervened", "infeasible"), 0)
    distance, worst, done, episode, spun = 0.0, 0.0, True, 0, False
    for _ in range(job.steps):
        if done:
            layout = {"ground": GROUNDS[episode % len(GROUNDS)], "agent": [0.0, 0.0, rng.uniform(-3, 3)]}
            env.reset(seed=1000 * job.seed + episode, options={"layout": layout})
            actions, episode, spun = driven(job.driver, raw, rng), episode + 1, False
        _, _, terminated, truncated, info = env.step(next(actions))
        done = terminated or truncated
        spins = bool(info["spin_out"])
        count["slipping"] += info["slip_max"] > SLIPPING
        count["spin_out"] += spins
        count["spin_outs_begun"] += spins and not spun
        count["yaw"] += info["yaw_rate_error"] > YAW_EXCURSION
        if job.limited:
            count["intervened"] += info["cbf/intervened"]
            count["infeasible"] += info["cbf/infeasible"]
        spun, worst = spins, max(worst, info["slip_max"])
        distance += abs(raw.forward_speed) * raw.dt
    return job._asdict() | count | {"worst_slip": worst, "mean_speed": distance / (job.steps * raw.dt)}


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: a line per driver, without and with."""
    lines: list[list[object]] = []
    for driver, limited in itertools.product(DRIVERS, (False, True)):
        part = [row for row in rows if (row["driver"], row["limited"]) == (driver, limited)]
        steps = total(part, "steps")
        begun = total(part, "spin_outs_begun") / (steps * 0.01 / 60.0)
        cells = [driver, "on" if limited else "off", f"{steps:,}", f"{total(part, 'slipping') / steps:.2%}"]
        cells += [f"{total(part, 'spin_out') / steps:.3%}", f"{begun:.1f}"]
        cells += [f"{total(part, 'yaw') / steps:.2%}", f"{max(row['worst_slip'] for row in part):.2f}"]
        cells.append(f"{np.mean([row['mean_speed'] for row in part]):.2f}")
        acted = [f"{total(part, 'intervened') / steps:.1%}", total(part, "infeasible")]
        lines.append([*cells, *(acted if limited else ["-", "-"])])
    head = "driver | limiter | steps | slip > 0.2 | spin-out | spin-outs / min | yaw excursion | worst slip"
    return markdown(f"{head} | mean speed (m/s) | changed | infeasible", lines)


def main() -> None:
    """Run the jobs in parallel, print the table."""
    given = options(__doc__, steps=200_000, workers=CORES)
    kinds = itertools.product(DRIVERS, (False, True), range(PARTS))
    jobs = [Job(driver, limited, given.steps // PARTS, part) for driver, limited, part in kinds]
    keep("slip", table(list(made(run, jobs, given.workers))))
