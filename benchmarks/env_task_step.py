"""Time of one env step of each task with a goal, with the judging of every physics substep included.

    python benchmarks/env_task_step.py

The driver steers towards the goal and drives through whatever stands in its way, so that level 2's figures
hold pushed and tumbling vases too. Reported: median and 99th percentile over steps, resets left out.
"""

import argparse
import time

import gymnasium as gym
import numpy as np

from safe_wrappers.envs import (
    CAR_GOAL_IDS,
    OCCLUDED_CROSSING_ID,
    POINT_GOAL_IDS,
    SAFE_ROVER_ID,
    register_envs,
)

LIMITS_US = (
    dict.fromkeys(POINT_GOAL_IDS, 150.0)
    | dict.fromkeys(CAR_GOAL_IDS, 400.0)
    | {SAFE_ROVER_ID: 300.0}
    | {OCCLUDED_CROSSING_ID: 250.0}
)
"""A tenth of what Safety-Gymnasium's steps take, or less; the rover and the crossing have no counterpart there."""


def step_times(env_id: str, steps: int, seed: int, bare: bool) -> np.ndarray:
    """Measure steps of one env.

    Args:
        env_id: Registered id.
        steps: Number of steps.
        seed: Seed of the first reset and of the driver's noise.
        bare: Measure the env alone, without `gymnasium.make`'s wrappers.

    Returns:
        Time per step, shape (steps,), us.
    """
    env = gym.make(env_id)
    inner = env.unwrapped
    if bare:
        env = inner
    rng = np.random.default_rng(seed)
    env.reset(seed=seed)
    times = np.empty(steps)
    for i in range(steps):
        to_goal = inner.goal_position - inner.agent_position
        bearing = np.arctan2(to_goal[1], to_goal[0]) - inner.agent_heading
        turn = np.clip(np.arctan2(np.sin(bearing), np.cos(bearing)), -1, 1)
        ahead = np.cos(bearing)
        if env_id == SAFE_ROVER_ID:  # torque on every wheel: speed is the driver's to keep
            steered = [0.3 * (2.0 - inner.forward_speed)] * 4 + [2.0 * turn]
        elif env_id == OCCLUDED_CROSSING_ID:  # forces along the world's axes
            steered = [2.0 * to_goal[0], 2.0 * to_goal[1], turn]
        else:
            steered = [ahead + turn, ahead - turn] if env_id in CAR_GOAL_IDS else [ahead, turn]
        action = np.clip(np.array(steered) + rng.normal(0, 0.3, len(steered)), -1, 1)
        start = time.perf_counter()
        env.step(action)
        times[i] = time.perf_counter() - start
        if (i + 1) % 1000 == 0:
            env.reset()
    inner.close()
    return times * 1e6


def main() -> None:
    """Print one line per level."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=5000, help="steps per env")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    register_envs()
    print(f"{'env':<20} {'median us':>10} {'p99 us':>8} {'with make() us':>15}")
    for env_id, limit in LIMITS_US.items():
        bare = step_times(env_id, args.steps, args.seed, bare=True)
        wrapped = step_times(env_id, args.steps, args.seed, bare=False)
        print(
            f"{env_id:<20} {np.median(bare):>10.1f} {np.percentile(bare, 99):>8.1f}"
            f" {np.median(wrapped):>15.1f}"
            f"   {'ok' if np.median(wrapped) <= limit else 'over'} ({limit:.0f})"
        )


if __name__ == "__main__":
    main()
