"""Where everything stands when an episode starts, and how a user asks for it."""

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError, UnknownNameError

from .levels import Level

LAYOUT_KEYS: Final = ("agent", "goal", "hazards", "vases")
"""What ``reset(options={"layout": {...}})`` understands; keys left out are sampled."""


@dataclass
class PartialLayout:
    """A layout of which only some parts are fixed; None means "sample it".

    Attributes:
        agent: Position and heading, shape (3,), m and rad.
        goal: Centre, shape (2,), m.
        hazards: Centres, shape (n, 2), m.
        vases: Centres, shape (n, 2), m.
    """

    agent: Array | None = None
    goal: Array | None = None
    hazards: Array | None = None
    vases: Array | None = None


@dataclass(frozen=True)
class Layout:
    """A whole layout: the same parts as `PartialLayout`, all of them known."""

    agent: Array
    goal: Array
    hazards: Array
    vases: Array


def parse_layout(options: Mapping[str, Any] | None, level: Level) -> PartialLayout:
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
    return PartialLayout(
        agent=numbers(given, "agent", "[x, y, heading]", (3,)),
        goal=numbers(given, "goal", "[x, y]", (2,)),
        hazards=points(given, "hazards", level.hazards),
        vases=points(given, "vases", level.vases),
    )


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
