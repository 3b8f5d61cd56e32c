"""Drivers for SafePointGoal, OccludedCrossing and PatrolledPointMaze that make life hard for a filter.

Each is a function of the unwrapped env, seeded; those of the crossing know nothing of cars.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Action = NDArray[np.float64]
Driver = Callable[[], Action]
Maker = Callable[[Any, np.random.Generator], Driver]


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


def hazard_seeking(env: Any, rng: np.random.Generator) -> Driver:
    """Into one obstacle after another, vases too; every 150 steps another one of the nearest three."""
    state = {"step": 0, "pick": 0}

    def act() -> Action:
        obstacles = _obstacles(env)
        if state["step"] % 150 == 0:
            state["pick"] = int(rng.integers(3))
        state["step"] += 1
        near = np.argsort(np.linalg.norm(obstacles - env.agent_position, axis=1))
        return towards(env, obstacles[near[state["pick"]]])

    return act


def lateral_drift(env: Any, rng: np.random.Generator) -> Driver:
    """Gather speed towards an obstacle, then turn, so that no actuator acts along the velocity."""
    state = {"step": 0, "pick": 0, "turn": 1.0, "drive": 0.0, "run": 60}

    def act() -> Action:
        obstacles = _obstacles(env)
        phase = state["step"] % 110
        if phase == 0:
            state.update(pick=int(rng.integers(len(obstacles))), run=int(rng.integers(30, 90)))
            state.update(turn=float(rng.choice([-1.0, 1.0])), drive=float(rng.choice([-1.0, 0.0, 1.0])))
        state["step"] += 1
        if phase < state["run"]:
            return towards(env, obstacles[state["pick"]])
        return np.array([state["drive"], state["turn"]])

    return act


def bang_bang(env: Any, rng: np.random.Generator) -> Driver:
    """Full throttle one way or the other, both actuators, held for random times."""
    return held(lambda: (int(rng.geometric(0.04)), rng.choice([-1.0, 1.0], size=2)))


def uniform(env: Any, rng: np.random.Generator) -> Driver:
    """Uniform random actions."""
    return lambda: rng.uniform(-1.0, 1.0, size=2)


def _obstacles(env: Any) -> NDArray[np.float64]:
    vases = env.vase_positions
    return np.concatenate([env.hazard_positions, vases]) if len(vases) else np.asarray(env.hazard_positions)


DRIVERS: dict[str, Maker] = {
    "random": uniform,
    "goal-seeking": goal_seeking,
    "hazard-seeking": hazard_seeking,
    "lateral-drift": lateral_drift,
    "bang-bang": bang_bang,
}
"""Of SafePointGoal."""


def across(env: Any, rng: np.random.Generator) -> Driver:
    """Straight to the goal as fast as the robot can, looking where it goes."""

    def act() -> Action:
        x, y = env.goal_position - env.agent_position
        turn = math.remainder(math.atan2(y, x) - env.agent_heading, math.tau)
        return np.clip([2.0 * x, 2.0 * y, 2.0 * turn], -1.0, 1.0)

    return act


def crossing_bang_bang(env: Any, rng: np.random.Generator) -> Driver:
    """Full force one way or the other along each axis, and full turns, held for random times (1 s on average)."""
    return held(lambda: (int(rng.geometric(0.04)), rng.choice([-1.0, 1.0], 3)))


def into_traffic(env: Any, rng: np.random.Generator) -> Driver:
    """To the middle of a lane and into its traffic: rests, then full force along or across it, by turns."""

    def draw() -> tuple[int, tuple[float, float, float, float]]:
        (along, across), left = rng.choice([-1.0, 0.0, 1.0], 2), int(rng.integers(5, 40))
        turn = float(rng.choice([-1.0, 0.0, 1.0]))
        return left, (along, across, turn, float(rng.choice(env.lane_centres)))

    current = held(draw)

    def act() -> Action:
        along, across, turn, lane = current()
        back = lane - env.agent_position[1]
        return np.clip([along, across if abs(back) < 1.0 else 2.0 * back, turn], -1.0, 1.0)

    return act


CROSSING: dict[str, Maker] = {"goal-seeking": across, "bang-bang": crossing_bang_bang, "pulse": into_traffic}


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


PATROLLED: dict[str, Maker] = {"patrol-seeking": patrol_seeking, "corridor": corridor}
