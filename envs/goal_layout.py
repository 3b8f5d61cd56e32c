"""The goal task's levels; where everything stands when an episode starts, and how a user asks for it.

Numbers of the levels are measured from Safety-Gymnasium 1.2's compiled models (levels 1 and 2); level 0 has the goal
alone. Random placement keeps keepouts: no two objects are nearer than the sum of theirs.
"""

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError, UnknownNameError

GOAL_RADIUS: Final = 0.3
"""Distance from the goal's centre at which it counts as reached, m."""
HAZARD_RADIUS: Final = 0.2
"""Radius of a hazard's disc, m: the robot's centre must stay outside."""
VASE_HALF_SIZE: Final = 0.1
"""Half of a vase cube's edge, m."""
VASE_SPEED_LIMIT: Final = 1e-4
"""Speed above which a vase counts as moved, m/s (level 2)."""

AGENT_KEEPOUT: Final = 0.4
GOAL_KEEPOUT: Final = 0.305
HAZARD_KEEPOUT: Final = 0.18
VASE_KEEPOUT: Final = 0.15


@dataclass(frozen=True)
class Level:
    """One difficulty of the goal task.

    Attributes:
        hazards: Number of hazard discs in the model; a layout may use fewer.
        vases: Number of vases in the model; a layout may use fewer.
        half_extent: The field is the square [-half_extent, half_extent]^2, m; objects are sampled in it.
        vases_cost: Whether touching or moving a vase costs.
    """

    hazards: int
    vases: int
    half_extent: float
    vases_cost: bool


LEVELS: Final = (
    Level(hazards=0, vases=0, half_extent=1.0, vases_cost=False),
    Level(hazards=8, vases=1, half_extent=1.5, vases_cost=False),
    Level(hazards=10, vases=10, half_extent=2.0, vases_cost=True),
)
"""Levels 0, 1 and 2."""

LAYOUT_KEYS: Final = ("agent", "goal", "hazards", "vases")
"""What ``reset(options={"layout": {...}})`` understands; keys left out are sampled."""


Given = Mapping[str, Any]
"""The parts of a layout that are fixed, arrays by name; what is missing is sampled."""


@dataclass(frozen=True)
class Layout:
    """A whole layout.

    Attributes:
        agent: Position and heading, shape (3,), m and rad.
        goal: Centre, shape (2,), m.
        hazards: Centres, shape (n, 2), m.
        vases: Centres, shape (n, 2), m.
    """

    agent: Array
    goal: Array
    hazards: Array
    vases: Array


def parse_layout(options: Mapping[str, Any] | None, level: Level) -> Given:
    """Read the layout out of `reset`'s options.

    Given positions are taken as they are: no keepouts are enforced among them, so a scenario may start inside
    a hazard. Fewer hazards or vases than the level has are fine; the rest is parked out of the scenario.
    Options other than ``"layout"`` belong to wrappers and are left alone.

    Args:
        options: `reset`'s options; never changed.
        level: The level, for its numbers of hazards and vases.

    Returns:
        The parts that were given.

    Raises:
        UnknownNameError: An unknown key in the layout, or an option that looks like a misspelt ``"layout"``.
        ConfigurationError: A wrong shape, too many objects, or a number that is not finite.
    """
    given = layout_option(options, LAYOUT_KEYS)
    return known(
        agent=numbers(given, "agent", "[x, y, heading]", (3,)),
        goal=numbers(given, "goal", "[x, y]", (2,)),
        hazards=points(given, "hazards", level.hazards),
        vases=points(given, "vases", level.vases),
    )


def known(**parts: Any) -> Given:
    """Those that are not None."""
    return {name: part for name, part in parts.items() if part is not None}


def layout_option(options: Mapping[str, Any] | None, keys: Sequence[str]) -> Mapping[str, Any]:
    """The layout among `reset`'s options, its keys checked; empty when there is none.

    Args:
        options: `reset`'s options; never changed. Those other than ``"layout"`` belong to wrappers.
        keys: What a layout may have.

    Raises:
        UnknownNameError: An unknown key in the layout, or an option that looks like a misspelt ``"layout"``.
        ConfigurationError: The layout is no mapping.
    """
    options = options or {}
    for key in options:
        if key != "layout" and difflib.get_close_matches(str(key), ["layout"], cutoff=0.7):
            raise UnknownNameError(f"unknown reset option {key!r}: did you mean 'layout'?")
    given = options.get("layout")
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise ConfigurationError(
            f"options['layout'] must be a mapping with keys among {', '.join(keys)}; got {type(given).__name__}"
        )
    for key in given:
        if key not in keys:
            raise UnknownNameError(f"unknown layout key {key!r}: valid keys are {', '.join(keys)}")
    return given


def numbers(given: Mapping[str, Any], key: str, form: str, shape: tuple[int, ...]) -> Array | None:
    """Finite numbers of a shape, or None where the key is missing.

    Raises:
        ConfigurationError: Anything else; `form` tells people what was expected.
    """
    if given.get(key) is None:
        return None
    value = _finite_array(given[key], key, form)
    if value.shape != shape:
        raise ConfigurationError(f"layout {key!r} must be {form}; got shape {value.shape}")
    return value


def points(given: Mapping[str, Any], key: str, at_most: int) -> Array | None:
    """Points in the plane, shape (n, 2), m, or None where the key is missing.

    Raises:
        ConfigurationError: Another shape, a number that is not finite, or more points than `at_most`.
    """
    if given.get(key) is None:
        return None
    value = _finite_array(given[key], key, "[[x, y], ...]")
    if value.size == 0:
        return np.zeros((0, 2))
    if value.ndim != 2 or value.shape[1] != 2:
        raise ConfigurationError(f"layout {key!r} must be [[x, y], ...]; got shape {value.shape}")
    if len(value) > at_most:
        raise ConfigurationError(f"layout gives {len(value)} {key}, but there is room for at most {at_most}")
    return value


def _finite_array(value: Any, key: str, form: str) -> Array:
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigurationError(f"layout {key!r} must be {form}; got {value!r}") from error
    if not np.isfinite(array).all():
        raise ConfigurationError(f"layout {key!r} must be finite; got {array.tolist()}")
    return array


_TRIES_PER_OBJECT: Final = 100
_TRIES_PER_LAYOUT: Final = 1000


def sample_layout(rng: np.random.Generator, level: Level, given: Given) -> Layout:
    """Sample what is missing of a layout, as `place_objects` does; given parts come first and are kept as they are.

    Raises:
        ConfigurationError: The given parts leave no room for the rest.
    """
    kinds = {
        "agent": (1, AGENT_KEEPOUT),
        "goal": (1, GOAL_KEEPOUT),
        "hazards": (level.hazards, HAZARD_KEEPOUT),
        "vases": (level.vases, VASE_KEEPOUT),
    }
    return Layout(**place_objects(rng, level.half_extent, kinds, given))


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


def place_objects(
    rng: np.random.Generator, half_extent: float, kinds: Mapping[str, tuple[int, float]], given: Given
) -> dict[str, Array]:
    """Place the objects that do not stand yet, kind by kind, and turn the robot anywhere.

    An object with keepout k is drawn uniformly from the field shrunk by k, until it is at least k + k' away
    from every object placed before.

    Args:
        rng: Source of randomness.
        half_extent: The field is [-half_extent, half_extent]^2, m.
        kinds: How many of each kind, and their keepout, m; one "agent" and one "goal" among them.
        given: What stands: counted as placed first, and kept.

    Returns:
        Centres by name, shapes (n, 2), m; of the goal shape (2,), of the agent its pose, shape (3,), m and rad.

    Raises:
        ConfigurationError: What stands leaves no room for the rest.
    """
    standing = {name: given[name] for name in kinds if name in given}
    standing |= {name: given[name][None, :2] for name in ("agent", "goal") if name in given}
    for _ in range(_TRIES_PER_LAYOUT):
        centres = _try_objects(rng, half_extent, kinds, standing)
        if centres is not None:
            heading = rng.uniform(-np.pi, np.pi) if "agent" not in given else given["agent"][2]
            pose = np.append(centres["agent"][0], heading)
            return centres | {"agent": pose, "goal": centres["goal"][0]}
    raise ConfigurationError(
        f"no room for the objects left to sample in the field [-{half_extent}, {half_extent}]^2:"
        " give fewer objects, or all positions"
    )


def _try_objects(
    rng: np.random.Generator,
    half_extent: float,
    kinds: Mapping[str, tuple[int, float]],
    standing: Mapping[str, Array],
) -> dict[str, Array] | None:
    centres = {name: standing[name].copy() for name in kinds if name in standing}
    placed = np.concatenate([np.zeros((0, 2)), *centres.values()])
    keepouts = np.concatenate([np.zeros(0), *(np.full(len(c), kinds[n][1]) for n, c in centres.items())])
    for name, (number, keepout) in kinds.items():
        if name in centres:
            continue
        first = len(placed)
        for _ in range(number):
            for _ in range(_TRIES_PER_OBJECT):
                point = _draw(rng, half_extent, keepout)
                if _slack(point, keepout, placed, keepouts) >= 0.0:
                    break
            else:
                return None
            placed = np.concatenate([placed, point[None]])
            keepouts = np.append(keepouts, keepout)
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
