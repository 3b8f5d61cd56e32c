"""Ego-motion from an IMU off the turning axis: how far off it is with and without the lever arm's acceleration.

    python -m benchmarks.ego_motion                  # two minutes on one core
    python -m benchmarks.ego_motion --episodes 1     # a look

OccludedCrossing's robot turns while it drives; its unit sits 0.15 m ahead of the axis, at the eye. The truth is the
env's. A "fix" gives the reckoning the true pose and velocity of the body, which without the arm are not the unit's.
Noise is that of a small MEMS unit: 0.02 m/s^2 and 0.002 rad/s in each control step of 0.04 s.
"""

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.crossing_drivers import DRIVERS
from benchmarks.tables import RESULTS, keep, markdown
from benchmarks.tracked import CROSSING, crossing

NOISE = {"accelerometer_std": 0.02, "gyro_std": 0.002}
STEPS = 500
"""Of an episode: 20 s."""


def drive(lever_arm: bool, noise: bool, fix_every_s: float | None, episodes: int) -> dict[str, Any]:
    """Errors of the body's reckoned position, m, and of the cars that are seen, over so many episodes."""
    imu = {"site": "eye", "lever_arm": lever_arm, "fix_every_s": fix_every_s} | (NOISE if noise else {})
    env = crossing(gym.make("OccludedCrossing-v0"), sensor=CROSSING["sensor"] | {"imu": imu})
    raw: Any = env.unwrapped
    own, cars, outside = [], [], []
    for seed in range(episodes):
        env.reset(seed=seed)
        act = DRIVERS["goal-seeking"](raw, np.random.default_rng(seed))
        turn = np.random.default_rng(seed)
        for step in range(STEPS):
            action = act()
            if step % 25 == 0:
                spin = turn.uniform(-1.0, 1.0)
            info = env.step(np.array([action[0], action[1], spin]))[4]
            assert env.ego_motion is not None
            own.append(float(np.linalg.norm(env.ego_motion.position[:2] - raw.agent_position)))
            seen = info["occlusion/visible"]
            error = (env.tracking.positions - raw.car_positions)[seen, 0]
            cars += np.abs(error).tolist()
            outside += (np.abs(error) > 3.0 * np.sqrt(env.tracking.covariance[seen, 0, 0])).tolist()
    return {
        "lever_arm": lever_arm,
        "noise": noise,
        "fix_every_s": fix_every_s,
        "steps": len(own),
        "median_m": float(np.median(own)),
        "p95_m": float(np.quantile(own, 0.95)),
        "largest_m": max(own),
        "cars_median_m": float(np.median(cars or [np.nan])),
        "cars_outside": float(np.mean(outside or [np.nan])),
    }


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = []
    for row in rows:
        fix = "at the reset" if row["fix_every_s"] is None else f"every {row['fix_every_s']:g} s"
        cells = ["compensated" if row["lever_arm"] else "left out", "MEMS" if row["noise"] else "none", fix]
        cells.append(f"{row['steps']:,}")
        cells += [f"{row[key]:.3f} m" for key in ("median_m", "p95_m", "largest_m", "cars_median_m")]
        lines.append([*cells, f"{row['cars_outside']:.1%}"])
    return markdown(
        "lever arm | noise | fix | steps | own position: median | 95 % below | largest | seen cars: median error"
        " | outside 3 sigma",
        lines,
    )


def main() -> None:
    """All combinations."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    rows = [
        drive(lever_arm, noise, fix_every_s, arguments.episodes)
        for noise in (False, True)
        for fix_every_s in (None, 2.0)
        for lever_arm in (True, False)
    ]
    keep(arguments.results, "ego_motion", rows, table(rows))


if __name__ == "__main__":
    main()
