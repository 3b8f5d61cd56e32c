"""When does the look-ahead of a speed limit refuse what the held control step admits? So: when can it be skipped?

    python -m benchmarks.look_ahead            # writes results/look_ahead.md
    python -m benchmarks.look_ahead Ant Hopper

Every control that the filter asks about is judged twice: by what its own control step leaves, and by what braking
after it leaves. Counted is where only the second refuses ("needed"), and how much the first left there at most, in
shares of the limit. A gate above that share (`SpeedLimit.look_ahead_below`) skips nothing that was needed.
"""

import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import safe_wrappers as sw
from benchmarks import mujoco_drivers as drivers
from safe_wrappers.constraints.limits.speed_limit import BoundSpeedLimit
from safe_wrappers.errors import UnsafeStateWarning
from safe_wrappers.recipes import LOOK_AHEAD_BELOW

RESULT = Path(__file__).parent / "results" / "look_ahead.md"
ROBOTS = ("HalfCheetah", "Ant", "Hopper", "Walker2d", "Humanoid", "Swimmer")
STEPS, SPRINTED = 1500, 400
HEAD = """# When the look-ahead can be skipped

`python -m benchmarks.look_ahead`. Controls that the filter asked about on `Safe<Robot>Velocity-v0`, with the limit
of the task. *Needed*: the control's own step keeps the limit, braking after it does not. *Largest room*: what the own
step left at most among those, in shares of the limit. *Skipped*: share of all controls that the gate of `protect`
spares the look.

| robot | driver | controls | changed steps | needed | largest room | gate | skipped | needed and skipped |
|---|---|---|---|---|---|---|---|---|
"""


class Recorded(BoundSpeedLimit):
    """Writes down, of every control asked about, what its own control step and what the steps after it leave."""

    seen: list[tuple[float, float]]

    def slacks(self, control: Any) -> Any:
        """As ever."""
        left = self.room(self.plant.forecast(control, self.spec.horizon)) - self.spec.margin
        own = len(left) // self.spec.horizon
        self.seen.append((float(left[:own].min()), float(left[own:].min())))
        return super().slacks(control)


def measure(robot: str, name: str, make: Callable[..., Any], steps: int) -> str:
    """One line of the table."""
    env = sw.protect(gym.make(f"Safe{robot}Velocity-v0"))
    bound: Any = env.filter.bound[0]
    bound.__class__ = Recorded
    limit, bound.seen, bound.spec.look_ahead_below = bound.spec.limit, [], None
    act, over, seed, changed = make(env.unwrapped, np.random.default_rng(1)), True, 10, 0
    for _ in range(steps):
        if over:
            seed += 1
            env.reset(seed=seed)
        _, _, terminated, truncated, info = env.step(np.asarray(act(), env.action_space.dtype))
        over, changed = terminated or truncated, changed + info["cbf/intervened"]
    own, after = np.array(bound.seen).T / limit
    needed = (own >= 0.0) & (after < 0.0)
    largest = f"{own[needed].max():.2f}" if needed.any() else "-"
    gate = LOOK_AHEAD_BELOW.get(robot)
    skipped = own >= (np.inf if gate is None else gate)
    return (
        f"| {robot} | {name} | {own.size:,} | {changed} | {needed.sum()} | {largest} | {gate or 'none'} | "
        f"{skipped.mean():.0%} | {(needed & skipped).sum()} |"
    )


def main() -> None:
    """Measure, print, and write the table if all robots were asked for."""
    warnings.simplefilter("ignore", UnsafeStateWarning)
    chosen = [r for r in ROBOTS if not sys.argv[1:] or r in sys.argv[1:]]
    lines = []
    for robot in chosen:
        sprinting = drivers.sprinting if robot in ("Ant", "Humanoid") else drivers.sprinting_along_x
        for name, make, steps in (
            ("random", drivers.random, STEPS),
            ("corners, 5 steps", drivers.corners(5), STEPS),
            ("corners, 20 steps", drivers.corners(20), STEPS),
            ("planned sprint", sprinting, SPRINTED),
        ):
            lines.append(measure(robot, name, make, steps))
            print(lines[-1], flush=True)
    if chosen == list(ROBOTS):
        RESULT.write_text(HEAD + "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
