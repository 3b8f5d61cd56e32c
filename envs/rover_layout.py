"""Where everything stands when the rover's episode starts, and how a user asks for it."""

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.errors import ConfigurationError, UnknownNameError

from .ground import GROUNDS, Patch

Array = NDArray[np.float64]

ROVER_LAYOUT_KEYS: Final = ("agent", "goal", "hazards", "patches", "ground", "speed")
"""What the rover's ``reset(options={"layout": {...}})`` understands."""
HALF_EXTENT: Final = 4.0
"""The field is the square [-4, 4]^2, m: objects are sampled in it; the rover may leave it."""
HAZARDS: Final = 6
"""Hazards in a sampled layout, and the most in a given one."""
SAMPLED_GROUNDS: Final = ("wet", "wet", "wet", "wet", "ice", "ice", "ice", "ice")
"""Grounds of the patches in a sampled layout; as many are the most in a given one."""

_PATCH_RADII: Final = (0.6, 1.0)  # m, uniform
_KEEPOUTS: Final = {"agent": 0.7, "goal": 0.5, "hazards": 0.4}  # m: no two centres nearer than their sum
_TRIES: Final = 100
_TRIES_PER_LAYOUT: Final = 100
_PATCH_KEYS: Final = ("ground", "center", "radius")


@dataclass(frozen=True)
class RoverLayout:
    """A whole layout.

    Attributes:
        agent: Position and heading, shape (3,), m and rad.
        goal: Centre, shape (2,), m.
        hazards: Centres, shape (n, 2), m.
        patches: Discs of another ground.
        ground: The ground everywhere else.
        speed: Of the rover along its heading at the start, its wheels rolling along, m/s.
    """

    agent: Array
    goal: Array
    hazards: Array
    patches: tuple[Patch, ...]
    ground: str
    speed: float


def parse_rover_layout(options: Mapping[str, Any] | None) -> dict[str, Any]:
    """Read the layout out of `reset`'s options: checked values by key, those that were given.

    Given positions are taken as they are: no keepouts are enforced among them. Options other than ``"layout"``
    belong to wrappers and are left alone.

    Args:
        options: `reset`'s options; never changed.

    Raises:
        UnknownNameError: An unknown layout key, ground or patch key, or what looks like a misspelt ``"layout"``.
        ConfigurationError: A wrong shape, too many objects, or a number out of its range.
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
            f"options['layout'] must be a mapping with keys among {', '.join(ROVER_LAYOUT_KEYS)};"
            f" got {type(given).__name__}"
        )
    for key in given:
        if key not in ROVER_LAYOUT_KEYS:
            raise UnknownNameError(
                f"unknown layout key {key!r}: valid keys are {', '.join(ROVER_LAYOUT_KEYS)}"
            )
    read = {
        "agent": lambda value: _numbers(value, "agent", "[x, y, heading]", 3),
        "goal": lambda value: _numbers(value, "goal", "[x, y]", 2),
        "hazards": _hazards,
        "patches": _patches,
        "ground": _ground,
        "speed": lambda value: float(_numbers([value], "speed", "a number of m/s", 1)[0]),
    }
    return {key: read[key](value) for key, value in given.items() if value is not None}


def sample_rover_layout(rng: np.random.Generator, given: Mapping[str, Any]) -> RoverLayout:
    """Sample what is missing of a layout; given parts are kept as they are.

    Agent, goal and hazards keep their keepouts from each other; patches lie anywhere, under whatever stands there,
    the icy ones on top. Without a word the ground is dry and the speed 0.

    Args:
        rng: Source of randomness.
        given: What `parse_rover_layout` returned.

    Raises:
        ConfigurationError: The given parts leave no room for the rest.
    """
    for _ in range(_TRIES_PER_LAYOUT):
        objects = _try_objects(rng, given)
        if objects is not None:
            break
    else:
        raise ConfigurationError(
            f"no room for the objects left to sample in the field [-{HALF_EXTENT}, {HALF_EXTENT}]^2:"
            " give all positions"
        )
    agent = given.get("agent")
    return RoverLayout(
        agent=np.append(objects["agent"][0], rng.uniform(-np.pi, np.pi)) if agent is None else agent,
        goal=objects["goal"][0],
        hazards=objects["hazards"],
        patches=given["patches"] if "patches" in given else _sample_patches(rng),
        ground=given.get("ground", "dry"),
        speed=given.get("speed", 0.0),
    )


def sample_rover_goal(rng: np.random.Generator, agent: Array, hazards: Array) -> Array:
    """Sample the next goal, shape (2,), m, beside the rover and the hazards.

    A crowded scenario must not end an episode with an error: where no try is clear, the clearest is taken.

    Args:
        rng: Source of randomness.
        agent: Rover's position, shape (2,), m.
        hazards: Centres, shape (n, 2), m.
    """
    placed = np.concatenate([agent[None], hazards])
    keepouts = np.repeat([_KEEPOUTS["agent"], _KEEPOUTS["hazards"]], [1, len(hazards)])
    best, best_slack = np.zeros(2), -math.inf
    for _ in range(_TRIES):
        point = _draw(rng, _KEEPOUTS["goal"])
        slack = _slack(point, _KEEPOUTS["goal"], placed, keepouts)
        if slack > best_slack:
            best, best_slack = point, slack
        if slack >= 0.0:
            break
    return best


def _try_objects(rng: np.random.Generator, given: Mapping[str, Any]) -> dict[str, Array] | None:
    known = {key: np.atleast_2d(given[key])[:, :2] for key in _KEEPOUTS if key in given}
    placed = np.concatenate([np.zeros((0, 2)), *known.values()])
    keepouts = np.concatenate([np.zeros(0), *(np.full(len(v), _KEEPOUTS[k]) for k, v in known.items())])
    for key, keepout in _KEEPOUTS.items():
        if key in known:
            continue
        first = len(placed)
        for _ in range(HAZARDS if key == "hazards" else 1):
            for _ in range(_TRIES):
                point = _draw(rng, keepout)
                if _slack(point, keepout, placed, keepouts) >= 0.0:
                    break
            else:
                return None
            placed, keepouts = np.concatenate([placed, point[None]]), np.append(keepouts, keepout)
        known[key] = placed[first:]
    return known


def _sample_patches(rng: np.random.Generator) -> tuple[Patch, ...]:
    patches = []
    for ground in SAMPLED_GROUNDS:
        radius = float(rng.uniform(*_PATCH_RADII))
        x, y = _draw(rng, radius).tolist()
        patches.append(Patch(ground, (x, y), radius))
    return tuple(patches)


def _draw(rng: np.random.Generator, keepout: float) -> Array:
    reach = HALF_EXTENT - keepout
    return rng.uniform(-reach, reach, size=2)


def _slack(point: Array, keepout: float, placed: Array, keepouts: Array) -> float:
    """Distance left over to the nearest placed object, m; infinite when there is none."""
    if not len(placed):
        return math.inf
    return float((np.hypot(placed[:, 0] - point[0], placed[:, 1] - point[1]) - keepouts - keepout).min())


def _hazards(value: Any) -> Array:
    form = "[[x, y], ...]"
    array = _finite_array(value, "hazards", form)
    if array.size == 0:
        return np.zeros((0, 2))
    if array.ndim != 2 or array.shape[1] != 2:
        raise ConfigurationError(f"layout 'hazards' must be {form}; got shape {array.shape}")
    if len(array) > HAZARDS:
        raise ConfigurationError(f"layout gives {len(array)} hazards, but there are at most {HAZARDS}")
    return array


def _patches(value: Any) -> tuple[Patch, ...]:
    if isinstance(value, str | Mapping) or not hasattr(value, "__iter__"):
        raise ConfigurationError(
            'layout \'patches\' must be a list of {"ground": name, "center": [x, y], "radius": m}; '
            f"got {value!r}"
        )
    patches = [_patch(item, f"patches[{i}]") for i, item in enumerate(value)]
    if len(patches) > len(SAMPLED_GROUNDS):
        raise ConfigurationError(
            f"layout gives {len(patches)} patches, but there are at most {len(SAMPLED_GROUNDS)}"
        )
    return tuple(patches)


def _patch(value: Any, where: str) -> Patch:
    if not isinstance(value, Mapping) or set(value) != set(_PATCH_KEYS):
        raise UnknownNameError(
            f"layout {where!r} must be a mapping with the keys {', '.join(_PATCH_KEYS)}; got {value!r}"
        )
    x, y = _numbers(value["center"], f"{where}['center']", "[x, y]", 2).tolist()
    radius = float(_numbers([value["radius"]], f"{where}['radius']", "a number of m", 1)[0])
    if radius <= 0.0:
        raise ConfigurationError(f"layout {where!r} must have a radius > 0 m; got {radius}")
    return Patch(_ground(value["ground"]), (x, y), radius)


def _ground(value: Any) -> str:
    if value not in GROUNDS:
        raise UnknownNameError(f"unknown ground {value!r}: valid grounds are {', '.join(GROUNDS)}")
    return str(value)


def _numbers(value: Any, key: str, form: str, length: int) -> Array:
    array = _finite_array(value, key, form)
    if array.shape != (length,):
        raise ConfigurationError(f"layout {key!r} must be {form}; got shape {array.shape}")
    return array


def _finite_array(value: Any, key: str, form: str) -> Array:
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigurationError(f"layout {key!r} must be {form}; got {value!r}") from error
    if not np.isfinite(array).all():
        raise ConfigurationError(f"layout {key!r} must be finite; got {array.tolist()}")
    return array
