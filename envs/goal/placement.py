"""Random placement with keepouts: no two objects nearer than the sum of their keepout radii."""

from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError

from .layout import Layout, PartialLayout
from .levels import AGENT_KEEPOUT, GOAL_KEEPOUT, HAZARD_KEEPOUT, VASE_KEEPOUT, Level

_TRIES_PER_OBJECT: Final = 100
_TRIES_PER_LAYOUT: Final = 1000


def sample_layout(rng: np.random.Generator, level: Level, given: PartialLayout) -> Layout:
    """Sample what is missing of a layout.

    As `place_objects` does; given parts come first and are kept as they are.

    Args:
        rng: Source of randomness.
        level: Numbers of objects and the field's extent.
        given: The parts to keep.

    Returns:
        The whole layout.

    Raises:
        ConfigurationError: The given parts leave no room for the rest.
    """
    agent = None if given.agent is None else given.agent[None, :2]
    goal = None if given.goal is None else given.goal[None]
    placed = place_objects(
        rng,
        level.half_extent,
        {
            "agent": Kind(1, AGENT_KEEPOUT, agent),
            "goal": Kind(1, GOAL_KEEPOUT, goal),
            "hazards": Kind(level.hazards, HAZARD_KEEPOUT, given.hazards),
            "vases": Kind(level.vases, VASE_KEEPOUT, given.vases),
        },
    )
    heading = rng.uniform(-np.pi, np.pi) if given.agent is None else given.agent[2]
    return Layout(
        agent=np.append(placed["agent"][0], heading),
        goal=placed["goal"][0],
        hazards=placed["hazards"],
        vases=placed["vases"],
    )


def sample_goal(rng: np.random.Generator, level: Level, agent: Array, hazards: Array, vases: Array) -> Array:
    """Sample the next goal beside everything that already stands in the field.

    A crowded scenario must not end an episode with an error: where no try is clear, the clearest is taken.

    Args:
        rng: Source of randomness.
        level: The field's extent.
        agent: Robot's position, shape (2,), m.
        hazards: Hazard centres, shape (n, 2), m.
        vases: Vase centres now, shape (n, 2), m.

    Returns:
        The goal's centre, shape (2,), m.
    """
    placed = np.concatenate([agent[None], hazards, vases])
    keepouts = np.repeat([AGENT_KEEPOUT, HAZARD_KEEPOUT, VASE_KEEPOUT], [1, len(hazards), len(vases)])
    return place_one(rng, level.half_extent, GOAL_KEEPOUT, placed, keepouts)


def place_one(
    rng: np.random.Generator,
    half_extent: float,
    keepout: float,
    placed: Array,
    keepouts: Array,
) -> Array:
    """Place one more object, shape (2,), m; where no try is clear, the clearest is taken.

    Args:
        rng: Source of randomness.
        half_extent: The field is [-half_extent, half_extent]^2, m.
        keepout: The object's, m.
        placed: Centres of the others, shape (n, 2), m.
        keepouts: Theirs, shape (n,), m.
    """
    best, best_slack = np.zeros(2), -np.inf
    for _ in range(_TRIES_PER_OBJECT):
        point = _draw(rng, half_extent, keepout)
        slack = _slack(point, keepout, placed, keepouts)
        if slack > best_slack:
            best, best_slack = point, slack
        if slack >= 0.0:
            break
    return best


class Kind(NamedTuple):
    """Objects of one kind.

    Attributes:
        number: How many to place.
        keepout: m.
        known: Their centres if they stand already, shape (n, 2), m.
    """

    number: int
    keepout: float
    known: Array | None


def place_objects(
    rng: np.random.Generator, half_extent: float, kinds: Mapping[str, Kind]
) -> dict[str, Array]:
    """Place the objects that do not stand yet, kind by kind.

    An object with keepout k is drawn uniformly from the field shrunk by k, until it is at least k + k' away
    from every object placed before.

    Args:
        rng: Source of randomness.
        half_extent: The field is [-half_extent, half_extent]^2, m.
        kinds: By name; those that stand count as placed first.

    Returns:
        Centres by name, shapes (n, 2), m.

    Raises:
        ConfigurationError: What stands leaves no room for the rest.
    """
    for _ in range(_TRIES_PER_LAYOUT):
        centres = _try_objects(rng, half_extent, kinds)
        if centres is not None:
            return centres
    raise ConfigurationError(
        f"no room for the objects left to sample in the field [-{half_extent}, {half_extent}]^2:"
        " give fewer objects, or all positions"
    )


def _try_objects(
    rng: np.random.Generator, half_extent: float, kinds: Mapping[str, Kind]
) -> dict[str, Array] | None:
    centres = {name: kind.known.copy() for name, kind in kinds.items() if kind.known is not None}
    placed = np.concatenate([np.zeros((0, 2)), *centres.values()])
    keepouts = np.concatenate([np.zeros(0), *(np.full(len(c), kinds[n].keepout) for n, c in centres.items())])
    for name, kind in kinds.items():
        if name in centres:
            continue
        first = len(placed)
        for _ in range(kind.number):
            for _ in range(_TRIES_PER_OBJECT):
                point = _draw(rng, half_extent, kind.keepout)
                if _slack(point, kind.keepout, placed, keepouts) >= 0.0:
                    break
            else:
                return None
            placed = np.concatenate([placed, point[None]])
            keepouts = np.append(keepouts, kind.keepout)
        centres[name] = placed[first:].copy()
    return centres


def _draw(rng: np.random.Generator, half_extent: float, keepout: float) -> Array:
    reach = half_extent - keepout
    return rng.uniform(-reach, reach, size=2)


def _slack(point: Array, keepout: float, placed: Array, keepouts: Array) -> float:
    """Distance left over to the nearest placed object, m; infinite when there is none."""
    if not len(placed):
        return np.inf
    gaps = np.hypot(placed[:, 0] - point[0], placed[:, 1] - point[1]) - keepouts - keepout
    return float(gaps.min())
