"""Drivers for OccludedCrossing that know nothing of cars; each is a function of the unwrapped env, seeded."""

import math
from typing import Any

import numpy as np

from benchmarks.drivers import Action, Driver, held
from benchmarks.mujoco_drivers import Maker


def goal_seeking(env: Any, rng: np.random.Generator) -> Driver:
    """Straight to the goal as fast as the robot can, looking where it goes."""

    def act() -> Action:
        x, y = env.goal_position - env.agent_position
        turn = math.remainder(math.atan2(y, x) - env.agent_heading, math.tau)
        return np.clip([2.0 * x, 2.0 * y, 2.0 * turn], -1.0, 1.0)

    return act


def bang_bang(env: Any, rng: np.random.Generator) -> Driver:
    """Full force one way or the other along each axis, and full turns, held for random times (1 s on average)."""
    return held(lambda: (int(rng.geometric(0.04)), rng.choice([-1.0, 1.0], 3)))


def pulse(env: Any, rng: np.random.Generator) -> Driver:
    """To the middle of a lane and into its traffic: rests, then full force along or across it, by turns."""
    state: dict[str, Any] = {"left": 0, "lane": 0.0, "force": np.zeros(2), "turn": 0.0}

    def act() -> Action:
        if state["left"] == 0:
            force = rng.choice([-1.0, 0.0, 1.0], 2)
            state.update(left=int(rng.integers(5, 40)), force=force, turn=float(rng.choice([-1.0, 0.0, 1.0])))
            state["lane"] = float(rng.choice(env.lane_centres))
        state["left"] -= 1
        back = state["lane"] - env.agent_position[1]
        along, across = state["force"]
        return np.clip([along, across if abs(back) < 1.0 else 2.0 * back, state["turn"]], -1.0, 1.0)

    return act


DRIVERS: dict[str, Maker] = {"goal-seeking": goal_seeking, "bang-bang": bang_bang, "pulse": pulse}
