"""Where everything stands when a crossing starts, and how a user asks for it."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError

from .layout import PLACE, POSE, Form, Given, parse_layout
from .traffic import CAR_MEAN_SPEED, CAR_SPEED_STD

FIELD: Final = (4.0, 3.5)
"""The field is ``|x| <= 4``, ``|y| <= 3.5``, m: rails keep the robot in it."""
LANE_CENTRES: Final = (-0.8, 0.8)
"""Their y, m: the first lane leads towards +x, the second towards -x."""
CARS_PER_LANE: Final = 3
CARS: Final = 2 * CARS_PER_LANE
PILLARS: Final = 4
"""Two on the lower pavement, then two on the upper one."""
ROBOT_RADIUS: Final = 0.2
PILLAR_RADIUS: Final = 0.35
CROSSING_GOAL_RADIUS: Final = 0.3
"""Distance from the goal's centre at which it counts as reached, m."""

_PAVEMENT: Final = 2.9  # m: |y| of starts and goals
_AGENT_REACH: Final = 2.0  # m: |x|
_GOAL_REACH: Final = 2.5
_PILLAR_REACH: Final = 3.0
_PILLAR_BAND: Final = (1.8, 2.0)  # m: |y|
_PILLAR_SPACING: Final = 1.5  # m between the centres of two on one side: the robot fits through
_CAR_START: Final = (-7.0, -2.0)  # m: the first of a lane, seen along it
_CAR_GAPS: Final = (5.0, 8.0)  # m between the centres of one and the next
_SPARE: Final = 0.05  # m between the robot and a pillar, at least
_TRIES: Final = 1000


_FORMS: Final[dict[str, Form]] = {
    "agent": POSE,
    "goal": PLACE,
    "cars": (f"[[x, v], ...] of {CARS} cars", (CARS, 2)),
    "pillars": (f"[[x, y], ...] of {PILLARS} pillars", (PILLARS, 2)),
}


def parse_crossing_layout(options: Mapping[str, Any] | None) -> Given:
    """Read the layout out of `reset`'s options, as `parse_layout` does.

    Raises:
        UnknownNameError: An unknown layout key, or what looks like a misspelt ``"layout"``.
        ConfigurationError: A wrong shape, a number that is not finite, or a robot that would stand outside the field
            or in a given pillar: it would be thrown out.
    """
    parsed = parse_layout(options, _FORMS)
    if "agent" in parsed:
        _check_agent(parsed["agent"][:2], parsed.get("pillars", np.zeros((0, 2))))
    return parsed


def _check_agent(place: Array, pillars: Array) -> None:
    room = np.array(FIELD) - ROBOT_RADIUS
    if (np.abs(place) > room).any():
        raise ConfigurationError(
            f"layout 'agent' must stand inside the rails, |x| <= {room[0]:g} and |y| <= {room[1]:g};"
            f" got {place.tolist()}"
        )
    if _slack(place, pillars) < 0.0:
        raise ConfigurationError(
            f"layout 'agent' stands in a pillar: its centre must be {ROBOT_RADIUS + PILLAR_RADIUS:g} m or more"
            f" from each pillar's; got {place.tolist()} and pillars {pillars.tolist()}"
        )


def sample_crossing_layout(rng: np.random.Generator, given: Given) -> dict[str, Array]:
    """Sample what is missing of a layout; given parts are kept as they are.

    The robot starts on the lower pavement and faces the road; the goal lies on the other side. In each lane the first
    car is 2 to 7 m before the field's middle and each next one 5 to 8 m behind; speeds are drawn from their
    stationary distribution.

    Args:
        rng: Source of randomness.
        given: The parts to keep.

    Raises:
        ConfigurationError: The given pillars leave the robot no place to start from.
    """
    parts = dict(given)
    if "agent" not in parts:
        place = _sample_clear(rng, _AGENT_REACH, -_PAVEMENT, given.get("pillars", np.zeros((0, 2))))
        parts["agent"] = np.append(place, 0.5 * np.pi)
    if "pillars" not in parts:
        parts["pillars"] = _sample_pillars(rng, parts["agent"], given.get("goal"))
    if "goal" not in parts:
        parts["goal"] = sample_crossing_goal(rng, parts["agent"][:2], parts["pillars"])
    if "cars" not in parts:
        parts["cars"] = _sample_cars(rng)
    return parts


def sample_crossing_goal(rng: np.random.Generator, agent: Array, pillars: Array) -> Array:
    """Sample a goal, shape (2,), m, on the pavement across the road, where the robot fits between the pillars.

    Four pillars leave at least 0.2 of the 5 m free, so there is a place wherever they stand.

    Args:
        rng: Source of randomness.
        agent: Robot's position, shape (2,), m; from the road's middle line, the goal is on the upper side.
        pillars: Centres, shape (4, 2), m.
    """
    side = _PAVEMENT if agent[1] <= 0.0 else -_PAVEMENT
    return _sample_clear(rng, _GOAL_REACH, side, pillars)


def _sample_clear(rng: np.random.Generator, reach: float, y: float, pillars: Array) -> Array:
    for _ in range(_TRIES):
        point = np.array([rng.uniform(-reach, reach), y])
        if _slack(point, pillars) >= _SPARE:
            return point
    raise ConfigurationError(
        f"no room for the robot at y = {y:g}, |x| <= {reach:g}: layout 'pillars' {pillars.tolist()} cover it;"
        " give other pillars, or 'agent' too"
    )


def _sample_pillars(rng: np.random.Generator, agent: Array, goal: Array | None) -> Array:
    """Pillars beside the robot, and beside the goal if that stands already."""
    taken = agent[None, :2] if goal is None else np.stack([agent[:2], goal])
    while True:  # robot and goal stand in the way of at most 2.4 m of the 12
        x = rng.uniform(-_PILLAR_REACH, _PILLAR_REACH, PILLARS)
        y = rng.uniform(*_PILLAR_BAND, PILLARS) * (-1.0, -1.0, 1.0, 1.0)
        pillars = np.stack([x, y], axis=1)
        apart = min(abs(x[0] - x[1]), abs(x[2] - x[3]))
        if apart >= _PILLAR_SPACING and min(_slack(point, pillars) for point in taken) >= _SPARE:
            return pillars


def _sample_cars(rng: np.random.Generator) -> Array:
    first = rng.uniform(*_CAR_START, (2, 1))
    gaps = rng.uniform(*_CAR_GAPS, (2, CARS_PER_LANE - 1))
    along = np.concatenate([first, first - np.cumsum(gaps, axis=1)], axis=1)
    speeds = rng.normal(CAR_MEAN_SPEED, CAR_SPEED_STD, (2, CARS_PER_LANE))
    directions = np.array([[1.0], [-1.0]])
    return np.stack([(directions * along).ravel(), (directions * speeds).ravel()], axis=1)


def _slack(point: Array, pillars: Array) -> float:
    """Room between the robot at a point and the nearest pillar, m; negative inside."""
    return float(np.hypot(*(pillars - point).T).min(initial=np.inf)) - ROBOT_RADIUS - PILLAR_RADIUS
