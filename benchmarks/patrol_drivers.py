"""Drivers that take PatrolledPointMaze's ball to the patrols; each is a function of the unwrapped env, seeded."""

from typing import Any

import numpy as np

from benchmarks.drivers import Action, Driver


def patrol_seeking(env: Any, rng: np.random.Generator) -> Driver:
    """Straight at the nearest patrol, at full force, hidden or not."""

    def act() -> Action:
        offsets = env.patrol_positions - env.agent_position
        return np.clip(5.0 * offsets[np.hypot(*offsets.T).argmin()], -1.0, 1.0)

    return act


def corridor(env: Any, rng: np.random.Generator) -> Driver:
    """Up and down the middle of the nearest corridor, turning about at random."""
    state: dict[str, Any] = {"left": 0, "way": 1.0}

    def act() -> Action:
        if state["left"] == 0:
            state.update(left=int(rng.integers(20, 150)), way=float(rng.choice([-1.0, 1.0])))
        state["left"] -= 1
        (_, y), (vx, vy) = env.agent_position, env.agent_velocity
        middle = env.patrol_positions[:, 1][np.abs(env.patrol_positions[:, 1] - y).argmin()]
        return np.clip([0.5 * state["way"] - 0.2 * vx * abs(vx), 3.0 * (middle - y) - 0.3 * vy], -1.0, 1.0)

    return act
