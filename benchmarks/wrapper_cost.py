"""What every wrapper of the stack adds to a control step, in microseconds.

    python -m benchmarks.wrapper_cost

Each row times an env with the wrapper and the same env without it, in turn, in short batches of control steps, and
gives the medians and their difference. Both sides are driven by the same random commands from the same seed; a chunk
counts as its control steps. The seams of random chunks are as rough as seams get: every one needs its blend.
"""

from collections.abc import Callable
from typing import Any

import gymnasium as gym

import safe_wrappers as sw
from benchmarks.timing import paired_us, stepping
from safe_wrappers.wrappers.faults import Outages

Wrap = Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]]

RAIL = [sw.constraints.Plane([-0.9], [1]), sw.constraints.Plane([0.9], [-1])]
SIZE, HORIZON, BATCH = 16, 8, 64


def reading(env: gym.Env[Any, Any]) -> tuple[float, float]:
    """A clearance that never runs out, so that what is timed is the lease and not the reading."""
    return 1.0, 0.1


def chunks(**options: Any) -> Wrap:
    """A ChunkHandover of the sizes above."""
    return lambda env: sw.ChunkHandover(env, SIZE, HORIZON, **options)


def bounded(blend: str) -> Wrap:
    """One that keeps a limit of a twentieth of the action range per control step."""

    def wrap(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
        space: Any = env.action_space
        limit = 0.05 * (space.high - space.low) / env.get_wrapper_attr("dt")
        return sw.ChunkHandover(env, SIZE, HORIZON, blend=blend, rate_limit=limit.tolist())

    return wrap


def protected_lease(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    """A lease from a Clearance, read from the MuJoCo model."""
    clearance = sw.constraints.Clearance(RAIL, bodies=["cart"], braking=8.0)
    return sw.LeaseExpiry(env, sw.StoppingBudget(clearance, acceleration=1.0))


ROWS: list[tuple[str, str, Wrap]] = [
    *(
        (env, f"ChunkHandover, {blend}", bounded(blend))
        for env in ("Reacher-v5", "FlexJointReach-v0", "HalfCheetah-v5")
        for blend in ("smoothstep", "quintic")
    ),
    ("Reacher-v5", "ChunkHandover, replacement", chunks(blend="replace")),
    (
        "Reacher-v5",
        "LeaseExpiry, the user's clearance",
        lambda env: sw.LeaseExpiry(env, sw.StoppingBudget(reading, braking=1.0, acceleration=0.1)),
    ),
    ("InvertedPendulum-v5", "LeaseExpiry, Clearance", protected_lease),
    (
        "InvertedPendulum-v5",
        "LeaseExpiry, Clearance, and Outages outside",
        lambda env: Outages(protected_lease(env), mean_between_s=1.0, mean_length_s=0.2),
    ),
    ("Reacher-v5", "RecordInterventions", sw.RecordInterventions),
    ("HalfCheetah-v5", "BalanceMonitor", sw.BalanceMonitor),
    ("Ant-v5", "BalanceMonitor", sw.BalanceMonitor),
]


def driver(env: gym.Env[Any, Any]) -> tuple[Callable[[], None], int]:
    """A function that makes one step with random actions, over and over, and its control steps."""
    space: Any = env.action_space
    return stepping(env), HORIZON if len(space.shape) > 1 else 1


def measure(env_id: str, wrap: Wrap, rounds: int = 40, batch: int = BATCH) -> tuple[float, float]:
    """Microseconds per control step without and with the wrapper."""
    bare, _ = driver(gym.make(env_id))
    wrapped, steps = driver(wrap(gym.make(env_id)))

    def one_batch(step: Callable[[], None], count: int) -> Callable[[], None]:
        def run() -> None:
            for _ in range(count):
                step()

        return run

    found = paired_us(
        {"without": one_batch(bare, batch), "with": one_batch(wrapped, batch // steps)},
        batch=1,
        rounds=rounds,
    )
    return found["without"] / batch, found["with"] / (batch // steps * steps)


def main() -> None:
    """Print the table."""
    print("| env | wrapper | step (us) | with it (us) | added (us) | ratio |\n|---|---|---|---|---|---|")
    for env_id, name, wrap in ROWS:
        without, with_it = measure(env_id, wrap)
        print(
            f"| {env_id} | {name} | {without:.0f} | {with_it:.0f} "
            f"| {with_it - without:.0f} | {with_it / without:.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
