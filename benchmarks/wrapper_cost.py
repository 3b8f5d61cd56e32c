"""What the wrappers around the filter add to a control step, in microseconds.

    python -m benchmarks wrapper_cost

Each row times an env with the wrapper and the same env without it, in turn, in short batches of control steps, and
gives the medians and their difference. Both sides are driven by the same random commands from the same seed; a chunk
counts as its control steps. The seams of random chunks are as rough as seams get: every one needs its blend.
"""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

import safe_wrappers as sw
from benchmarks.tables import markdown, options, paired_us

Wrap = Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]]
SIZE, HORIZON, BATCH = 16, 8, 64


def handover(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    """Chunks, blended within a limit of a twentieth of the action range per control step."""
    space: Any = env.action_space
    limit = 0.05 * (space.high - space.low) / env.get_wrapper_attr("dt")
    return sw.ChunkHandover(env, SIZE, HORIZON, rate_limit=limit.tolist())


def lease(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    """A lease from a Clearance, read from the MuJoCo model."""
    rail = [sw.constraints.Plane([-0.9], [1]), sw.constraints.Plane([0.9], [-1])]
    clearance = sw.constraints.Clearance(rail, bodies=["cart"], braking=8.0)
    return sw.LeaseExpiry(env, sw.StoppingBudget(clearance, acceleration=1.0))


ROWS: list[tuple[str, str, Wrap]] = [
    ("Reacher-v5", "ChunkHandover", handover),
    ("HalfCheetah-v5", "ChunkHandover", handover),
    ("InvertedPendulum-v5", "LeaseExpiry", lease),
    ("Reacher-v5", "RecordInterventions", sw.RecordInterventions),
    ("Ant-v5", "BalanceMonitor", sw.BalanceMonitor),
]


def stepping(env: gym.Env[Any, Any]) -> Callable[[], None]:
    """A function that makes `BATCH` control steps, over and over, with the same random actions."""
    env.reset(seed=0)
    space: Any = env.action_space
    actions = np.random.default_rng(0).uniform(space.low, space.high, (256, *space.shape)).astype(space.dtype)
    turn, held = 0, HORIZON if len(space.shape) > 1 else 1

    def steps() -> None:
        nonlocal turn
        for _ in range(BATCH // held):
            turn += 1
            if any(env.step(actions[turn % len(actions)])[2:4]):
                env.reset(seed=0)

    return steps


def measure(env_id: str, wrap: Wrap, rounds: int = 40) -> tuple[float, float]:
    """Microseconds per control step without and with the wrapper."""
    sides = {"without": stepping(gym.make(env_id)), "with": stepping(wrap(gym.make(env_id)))}
    found = paired_us(sides, batch=1, rounds=rounds)
    return found["without"] / BATCH, found["with"] / BATCH


def main() -> None:
    """Print the table."""
    options(__doc__)
    lines = []
    for env_id, name, wrap in ROWS:
        without, with_it = measure(env_id, wrap)
        times = [f"{us:.0f}" for us in (without, with_it, with_it - without)]
        lines.append([env_id, name, *times, f"{with_it / without:.2f}"])
    print(markdown("env | wrapper | step (us) | with it (us) | added (us) | ratio", lines))
