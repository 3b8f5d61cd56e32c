"""Random placement with keepouts: no two objects nearer than the sum of their keepout radii."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.errors import ConfigurationError

from .layout import Layout, PartialLayout
from .levels import AGENT_KEEPOUT, GOAL_KEEPOUT, HAZARD_KEEPOUT, VASE_KEEPOUT, Level

_TRIES_PER_OBJECT: Final = 100
_TRIES_PER_LAYOUT: Final = 1000


def sample_layout(rng: np.random.Generator, level: Level, given: PartialLayout) -> Layout:
    """Sample what is missing of a layout.

    An object with keepout k is drawn uniformly from the field shrunk by k, until it is at least k + k' away
    from every object placed before. Given parts come first and are kept as they are.

    Args:
        rng: Source of randomness.
        level: Numbers of objects and the field's extent.
        given: The parts to keep.

    Returns:
        The whole layout.

    Raises:
        ConfigurationError: The given parts leave no room for the rest.
    """
    for _ in range(_TRIES_PER_LAYOUT):
        layout = _try_layout(rng, level, given)
        if layout is not None:
            return layout
    raise ConfigurationError(
        f"no room for the objects left to sample in the field [-{level.half_extent}, {level.half_extent}]^2:"
        " give fewer hazards and vases, or all positions"
    )


def sample_goal(
    rng: np.random.Generator,
    level: Level,
    agent: NDArray[np.float64],
    hazards: NDArray[np.float64],
    vases: NDArray[np.float64],
) -> NDArray[np.float64]:
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
    best, best_slack = np.zeros(2), -np.inf
    for _ in range(_TRIES_PER_OBJECT):
        point = _draw(rng, level, GOAL_KEEPOUT)
        slack = _slack(point, GOAL_KEEPOUT, placed, keepouts)
        if slack > best_slack:
            best, best_slack = point, slack
        if slack >= 0.0:
            break
    return best


def _try_layout(rng: np.random.Generator, level: Level, given: PartialLayout) -> Layout | None:
    agent = None if given.agent is None else given.agent[None, :2]
    goal = None if given.goal is None else given.goal[None]
    parts = {
        "agent": (agent, 1, AGENT_KEEPOUT),
        "goal": (goal, 1, GOAL_KEEPOUT),
        "hazards": (given.hazards, level.hazards, HAZARD_KEEPOUT),
        "vases": (given.vases, level.vases, VASE_KEEPOUT),
    }
    placed = np.zeros((0, 2))
    keepouts = np.zeros(0)
    chosen: dict[str, NDArray[np.float64]] = {}
    for name, (known, _, keepout) in parts.items():
        if known is not None:
            chosen[name] = known
            placed = np.concatenate([placed, known])
            keepouts = np.concatenate([keepouts, np.full(len(known), keepout)])
    for name, (known, count, keepout) in parts.items():
        if known is not None:
            continue
        first = len(placed)
        for _ in range(count):
            for _ in range(_TRIES_PER_OBJECT):
                point = _draw(rng, level, keepout)
                if _slack(point, keepout, placed, keepouts) >= 0.0:
                    break
            else:
                return None
            placed = np.concatenate([placed, point[None]])
            keepouts = np.append(keepouts, keepout)
        chosen[name] = placed[first:]
    heading = rng.uniform(-np.pi, np.pi) if given.agent is None else given.agent[2]
    return Layout(
        agent=np.append(chosen["agent"][0], heading),
        goal=chosen["goal"][0].copy(),
        hazards=chosen["hazards"].copy(),
        vases=chosen["vases"].copy(),
    )


def _draw(rng: np.random.Generator, level: Level, keepout: float) -> NDArray[np.float64]:
    reach = level.half_extent - keepout
    return rng.uniform(-reach, reach, size=2)


def _slack(
    point: NDArray[np.float64], keepout: float, placed: NDArray[np.float64], keepouts: NDArray[np.float64]
) -> float:
    """Distance left over to the nearest placed object, m; infinite when there is none."""
    if not len(placed):
        return np.inf
    gaps = np.hypot(placed[:, 0] - point[0], placed[:, 1] - point[1]) - keepouts - keepout
    return float(gaps.min())
