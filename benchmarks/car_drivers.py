"""Drivers for SafeCarGoal that make life hard for a filter; each is a function of the env, seeded.

The motors saturate at a control of 0.02: what lies beyond is full torque.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.drivers import Action, Driver, Maker, held
from safe_wrappers.errors import Array

_FULL = 0.02


def towards(env: Any, target: Array, strength: float = _FULL) -> Action:
    """Turn towards a point while driving, knowing nothing of what stands in the way."""
    offset = target - env.agent_position
    bearing = math.remainder(math.atan2(offset[1], offset[0]) - env.agent_heading, math.tau)
    # More on the first wheel turns to the left.
    return strength * np.clip([1.0 + 2.0 * bearing, 1.0 - 2.0 * bearing], 0.0, 1.0)


def goal_seeking(env: Any, rng: np.random.Generator) -> Driver:
    """Straight to the goal."""
    return lambda: towards(env, env.goal_position)


def hazard_seeking(env: Any, rng: np.random.Generator) -> Driver:
    """Into one hazard after another; every 75 steps another one of the nearest three."""
    return _seeking(env, rng, lambda: np.asarray(env.hazard_positions))


def _seeking(env: Any, rng: np.random.Generator, where: Callable[[], Array]) -> Driver:
    state: dict[str, Any] = {"step": 0, "pick": 0, "sense": 1.0, "strength": _FULL}

    def act() -> Action:
        targets = where()
        if state["step"] % 75 == 0:
            state.update(pick=int(rng.integers(3)), sense=float(rng.choice([-1.0, 1.0])))
            state.update(strength=float(rng.choice([0.5, 1.0])) * _FULL)
        state["step"] += 1
        near = np.argsort(np.linalg.norm(targets - env.agent_position, axis=1))
        target = targets[near[state["pick"] % len(targets)]]
        if state["sense"] > 0.0:
            return towards(env, target, state["strength"])
        # The mirror of the target leads backwards into it.
        return -towards(env, 2.0 * env.agent_position - target, state["strength"])[::-1]

    return act


def bang_bang(env: Any, rng: np.random.Generator) -> Driver:
    """Full torque one way or the other, both wheels, held for random times."""
    return _in_the_field(env, held(lambda: (int(rng.geometric(0.08)), rng.choice([-1.0, 1.0], size=2))))


def full_throttle(env: Any, rng: np.random.Generator) -> Driver:
    """Run at an obstacle at top speed, then kick the wheels any way when it is near."""
    state: dict[str, Any] = {"step": 0, "pick": 0, "run": 40, "kick": np.ones(2)}

    def act() -> Action:
        targets = np.concatenate([env.hazard_positions, env.vase_positions])
        phase = state["step"] % 60
        if phase == 0:
            state.update(pick=int(rng.integers(len(targets))), run=int(rng.integers(20, 60)))
            state.update(kick=rng.choice([-1.0, 0.0, 1.0], size=2))
        state["step"] += 1
        if phase < state["run"]:
            return np.sign(towards(env, targets[state["pick"]]) - 0.1 * _FULL)
        return np.array(state["kick"])

    return act


def pulse(env: Any, rng: np.random.Generator) -> Driver:
    """Nothing, then a kick of one or two steps."""
    state = {"left": 0}

    def act() -> Action:
        state["left"] -= 1
        if state["left"] < -int(rng.integers(1, 12)):
            state["left"] = int(rng.integers(1, 3))
        return rng.choice([-1.0, 0.0, 1.0], size=2) if state["left"] > 0 else np.zeros(2)

    return _in_the_field(env, act)


def uniform(env: Any, rng: np.random.Generator) -> Driver:
    """Uniform random actions."""
    return _in_the_field(env, lambda: rng.uniform(-1.0, 1.0, size=2))


def _in_the_field(env: Any, driver: Driver) -> Driver:
    """A driver that goes back to the middle, over all that stands there, whenever it has left the field."""
    state = {"home": False}

    def act() -> Action:
        distance = float(np.linalg.norm(env.agent_position))
        state["home"] = distance > env.level.half_extent or (state["home"] and distance > 0.5)
        return towards(env, np.zeros(2)) if state["home"] else driver()

    return act


DRIVERS: dict[str, Maker] = {
    "random": uniform,
    "goal-seeking": goal_seeking,
    "hazard-seeking": hazard_seeking,
    "vase-seeking": lambda env, rng: _seeking(env, rng, lambda: np.asarray(env.vase_positions)),
    "bang-bang": bang_bang,
    "full throttle": full_throttle,
    "pulse": pulse,
}
