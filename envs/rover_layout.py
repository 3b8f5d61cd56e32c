"""Where everything stands when the rover's episode starts, and how a user asks for it."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from safe_wrappers.errors import ConfigurationError, UnknownNameError

from .ground import GROUNDS, Patch
from .layout import PLACE, POSE, Form, Given, layout_option, numbers, place_objects, places

HALF_EXTENT: Final = 4.0
"""The field is the square [-4, 4]^2, m: objects are sampled in it; the rover may leave it."""
HAZARDS: Final = 6
"""Hazards in a sampled layout, and the most in a given one."""
SAMPLED_GROUNDS: Final = ("wet", "wet", "wet", "wet", "ice", "ice", "ice", "ice")
"""Grounds of the patches in a sampled layout; as many are the most in a given one."""
KEEPOUTS: Final = {"agent": 0.7, "goal": 0.5, "hazards": 0.4}
"""m; patches have none."""

_PATCH_RADII: Final = (0.6, 1.0)  # m, uniform
_PATCH_KEYS: Final = ("ground", "center", "radius")
_FORMS: Final[dict[str, Form]] = {
    "agent": POSE,
    "goal": PLACE,
    "hazards": places(HAZARDS),
    "speed": ("a number of m/s", ()),
}
ROVER_LAYOUT_KEYS: Final = ("agent", "goal", "hazards", "patches", "ground", "speed")
"""What the rover's ``reset(options={"layout": {...}})`` understands."""


def parse_rover_layout(options: Mapping[str, Any] | None) -> Given:
    """Read the layout out of `reset`'s options, as `parse_layout` does; without a word ground is dry and speed 0.

    Raises:
        UnknownNameError: An unknown layout key, ground or patch key, or what looks like a misspelt ``"layout"``.
        ConfigurationError: A wrong shape, too many objects, or a number out of its range.
    """
    given = layout_option(options, ROVER_LAYOUT_KEYS)
    found: dict[str, Any] = {"speed": 0.0, "ground": _ground(given.get("ground", "dry"))}
    found |= {key: numbers(given[key], key, form) for key, form in _FORMS.items() if key in given}
    if "patches" in given:
        found["patches"] = _patches(given["patches"])
    return {**found, "speed": float(found["speed"])}


def sample_rover_layout(rng: np.random.Generator, given: Given) -> dict[str, Any]:
    """Sample what is missing of a layout; given parts are kept as they are.

    Agent, goal and hazards keep their keepouts from each other; patches lie anywhere, under whatever stands there,
    the icy ones on top.

    Args:
        rng: Source of randomness.
        given: The parts to keep.

    Raises:
        ConfigurationError: The given parts leave no room for the rest.
    """
    placed = place_objects(rng, HALF_EXTENT, KEEPOUTS, {"hazards": HAZARDS}, given)
    patches = given["patches"] if "patches" in given else _sample_patches(rng)
    return {**placed, "patches": patches, "ground": given["ground"], "speed": given["speed"]}


def _sample_patches(rng: np.random.Generator) -> tuple[Patch, ...]:
    patches = []
    for ground in SAMPLED_GROUNDS:
        radius = float(rng.uniform(*_PATCH_RADII))
        x, y = rng.uniform(radius - HALF_EXTENT, HALF_EXTENT - radius, size=2).tolist()
        patches.append(Patch(ground, (x, y), radius))
    return tuple(patches)


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
    x, y = numbers(value["center"], f"{where}['center']", PLACE).tolist()
    radius = float(numbers(value["radius"], f"{where}['radius']", ("a number of m", ())))
    if radius <= 0.0:
        raise ConfigurationError(f"layout {where!r} must have a radius > 0 m; got {value!r}")
    return Patch(_ground(value["ground"]), (x, y), radius)


def _ground(value: Any) -> str:
    if not (isinstance(value, str) and value in GROUNDS):
        raise UnknownNameError(f"unknown ground {value!r}: valid grounds are {', '.join(GROUNDS)}")
    return value
