"""Drivers for SafeCarGoal that make life hard for a filter; each is a function of the env, seeded.

The motors saturate at a control of 0.02: what lies beyond is full torque.
"""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from benchmarks import drivers
from benchmarks.drivers import Action, Driver, Maker, stepwise
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


def _seeking(places: str) -> Maker:
    """Into one after another of the env's places of this name; every 75 steps another one of the nearest three."""

    @stepwise
    def seek(env: Any, rng: np.random.Generator) -> Iterator[Action]:
        while True:
            pick, backwards = int(rng.integers(3)), rng.choice([-1.0, 1.0]) < 0.0
            strength = float(rng.choice([0.5, 1.0])) * _FULL
            for _ in range(75):
                targets = np.asarray(getattr(env, places))
                near = np.argsort(np.linalg.norm(targets - env.agent_position, axis=1))
                target = targets[near[pick % len(targets)]]
                if backwards:  # the mirror of the target leads backwards into it
                    yield -towards(env, 2.0 * env.agent_position - target, strength)[::-1]
                else:
                    yield towards(env, target, strength)

    return seek


@stepwise
def full_throttle(env: Any, rng: np.random.Generator) -> Iterator[Action]:
    """Run at an obstacle at top speed, then kick the wheels any way when it is near."""
    while True:
        pick, run = int(rng.integers(len(drivers.obstacles(env)))), int(rng.integers(20, 60))
        kick = rng.choice([-1.0, 0.0, 1.0], size=2)
        for step in range(60):
            ahead = np.sign(towards(env, drivers.obstacles(env)[pick]) - 0.1 * _FULL)
            yield ahead if step < run else kick.copy()


@stepwise
def pulse(env: Any, rng: np.random.Generator) -> Iterator[Action]:
    """Nothing, then a kick of one or two steps."""
    left = 0
    while True:
        left -= 1
        if left < -int(rng.integers(1, 12)):
            left = int(rng.integers(1, 3))
        yield rng.choice([-1.0, 0.0, 1.0], size=2) if left > 0 else np.zeros(2)


def _in_the_field(maker: Maker) -> Maker:
    """A driver that goes back to the middle, over all that stands there, whenever it has left the field."""

    @stepwise
    def drive(env: Any, rng: np.random.Generator) -> Iterator[Action]:
        act, homewards = maker(env, rng), False
        while True:
            distance = float(np.linalg.norm(env.agent_position))
            homewards = distance > env.level.half_extent or (homewards and distance > 0.5)
            yield towards(env, np.zeros(2)) if homewards else act()

    return drive


DRIVERS: dict[str, Maker] = {
    "random": _in_the_field(drivers.uniform),
    "goal-seeking": goal_seeking,
    "hazard-seeking": _seeking("hazard_positions"),
    "vase-seeking": _seeking("vase_positions"),
    "bang-bang": _in_the_field(drivers.bang_bang(0.08)),
    "full throttle": full_throttle,
    "pulse": _in_the_field(pulse),
}
