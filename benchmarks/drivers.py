"""Drivers for SafePointGoal, OccludedCrossing and PatrolledPointMaze that make life hard for a filter.

Each is a function of the unwrapped env, seeded; those of the crossing know nothing of cars.
"""

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

Action = NDArray[np.float64]
Driver = Callable[[], Action]
Maker = Callable[[Any, np.random.Generator], Driver]


def stepwise(actions: Callable[[Any, np.random.Generator], Iterator[Action]]) -> Maker:
    """Makes a driver of a generator, which yields one action per control step."""
    return lambda env, rng: partial(next, actions(env, rng))


def held(draw: Callable[[], tuple[int, Any]]) -> Callable[[], Any]:
    """What was drawn, for as many steps as were drawn with it; then drawn anew."""
    left, value = 0, None

    def current() -> Any:
        nonlocal left, value
        if left == 0:
            left, value = draw()
        left -= 1
        return value

    return current


def towards(env: Any, target: NDArray[np.float64]) -> Action:
    """Turn towards a point and push on, knowing nothing of hazards."""
    offset = target - env.agent_position
    angle = math.atan2(offset[1], offset[0]) - env.agent_heading
    angle = (angle + math.pi) % (2.0 * math.pi) - math.pi
    return np.array([math.cos(angle), np.clip(3.0 * angle, -1.0, 1.0)])


def goal_seeking(env: Any, rng: np.random.Generator) -> Driver:
    """Straight to the goal, blind to hazards and vases."""
    return lambda: towards(env, env.goal_position)


@stepwise
def hazard_seeking(env: Any, rng: np.random.Generator) -> Iterator[Action]:
    """Into one obstacle after another, vases too; every 150 steps another one of the nearest three."""
    while True:
        pick = int(rng.integers(3))
        for _ in range(150):
            places = obstacles(env)
            near = np.argsort(np.linalg.norm(places - env.agent_position, axis=1))
            yield towards(env, places[near[pick]])


@stepwise
def lateral_drift(env: Any, rng: np.random.Generator) -> Iterator[Action]:
    """Gather speed towards an obstacle, then turn, so that no actuator acts along the velocity."""
    while True:
        pick, run = int(rng.integers(len(obstacles(env)))), int(rng.integers(30, 90))
        turn, drive = rng.choice([-1.0, 1.0]), rng.choice([-1.0, 0.0, 1.0])
        for step in range(110):
            yield towards(env, obstacles(env)[pick]) if step < run else np.array([drive, turn])


def bang_bang(often: float, size: int = 2) -> Maker:
    """All actuators at one end or the other, held for random times; `often` is the share of steps with a change."""
    return lambda env, rng: held(lambda: (int(rng.geometric(often)), rng.choice([-1.0, 1.0], size)))


def uniform(env: Any, rng: np.random.Generator) -> Driver:
    """Uniform random actions."""
    return lambda: rng.uniform(-1.0, 1.0, size=2)


def obstacles(env: Any) -> NDArray[np.float64]:
    """Places of all hazards and vases."""
    return np.concatenate([env.hazard_positions, env.vase_positions])


DRIVERS: dict[str, Maker] = {
    "random": uniform,
    "goal-seeking": goal_seeking,
    "hazard-seeking": hazard_seeking,
    "lateral-drift": lateral_drift,
    "bang-bang": bang_bang(0.04),
}
"""Of SafePointGoal."""


@stepwise
def across(env: Any, rng: np.random.Generator) -> Iterator[Action]:
    """Straight to the goal as fast as the robot can, looking where it goes."""
    while True:
        x, y = env.goal_position - env.agent_position
        turn = math.remainder(math.atan2(y, x) - env.agent_heading, math.tau)
        yield np.clip([2.0 * x, 2.0 * y, 2.0 * turn], -1.0, 1.0)


@stepwise
def into_traffic(env: Any, rng: np.random.Generator) -> Iterator[Action]:
    """To the middle of a lane and into its traffic: rests, then full force along or across it, by turns."""
    while True:
        (along, across), left = rng.choice([-1.0, 0.0, 1.0], 2), int(rng.integers(5, 40))
        turn, lane = rng.choice([-1.0, 0.0, 1.0]), rng.choice(env.lane_centres)
        for _ in range(left):
            back = lane - env.agent_position[1]
            yield np.clip([along, across if abs(back) < 1.0 else 2.0 * back, turn], -1.0, 1.0)


CROSSING: dict[str, Maker] = {
    "goal-seeking": across,
    "bang-bang": bang_bang(0.04, size=3),
    "pulse": into_traffic,
}


@stepwise
def patrol_seeking(env: Any, rng: np.random.Generator) -> Iterator[Action]:
    """Straight at the nearest patrol, at full force, hidden or not."""
    while True:
        offsets = env.patrol_positions - env.agent_position
        yield np.clip(5.0 * offsets[np.hypot(*offsets.T).argmin()], -1.0, 1.0)


@stepwise
def corridor(env: Any, rng: np.random.Generator) -> Iterator[Action]:
    """Up and down the middle of the nearest corridor, turning about at random."""
    way = held(lambda: (int(rng.integers(20, 150)), float(rng.choice([-1.0, 1.0]))))
    while True:
        (_, y), (vx, vy) = env.agent_position, env.agent_velocity
        middle = env.patrol_positions[:, 1][np.abs(env.patrol_positions[:, 1] - y).argmin()]
        yield np.clip([0.5 * way() - 0.2 * vx * abs(vx), 3.0 * (middle - y) - 0.3 * vy], -1.0, 1.0)


PATROLLED: dict[str, Maker] = {"patrol-seeking": patrol_seeking, "corridor": corridor}
