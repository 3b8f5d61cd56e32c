"""Drivers that take PatrolledPointMaze's ball to the patrols; each is a function of the unwrapped env, seeded."""

from typing import Any

import numpy as np

from benchmarks.drivers import Action, Driver, held


def patrol_seeking(env: Any, rng: np.random.Generator) -> Driver:
    """Straight at the nearest patrol, at full force, hidden or not."""

    def act() -> Action:
        offsets = env.patrol_positions - env.agent_position
        return np.clip(5.0 * offsets[np.hypot(*offsets.T).argmin()], -1.0, 1.0)

    return act


def corridor(env: Any, rng: np.random.Generator) -> Driver:
    """Up and down the middle of the nearest corridor, turning about at random."""
    way = held(lambda: (int(rng.integers(20, 150)), float(rng.choice([-1.0, 1.0]))))

    def act() -> Action:
        (_, y), (vx, vy) = env.agent_position, env.agent_velocity
        middle = env.patrol_positions[:, 1][np.abs(env.patrol_positions[:, 1] - y).argmin()]
        return np.clip([0.5 * way() - 0.2 * vx * abs(vx), 3.0 * (middle - y) - 0.3 * vy], -1.0, 1.0)

    return act
