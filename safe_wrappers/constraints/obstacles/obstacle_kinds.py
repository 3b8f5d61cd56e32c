"""Obstacles as plain data, so that a constraint that holds them can be recorded and rebuilt."""

from collections.abc import Sequence
from typing import Any

from safe_wrappers.checks import settings_from
from safe_wrappers.constraints.obstacles.obstacles import Box, Disc, Discs, Obstacle, Plane, Sphere
from safe_wrappers.constraints.obstacles.tracked_discs import TrackedDiscs
from safe_wrappers.errors import ConfigurationError

KINDS: dict[str, type[Any]] = {
    kind.__name__: kind for kind in (Disc, Sphere, Plane, Box, Discs, TrackedDiscs)
}


def obstacle_from(data: Any) -> Obstacle:
    """An obstacle itself, or rebuilt from the plain dict that a recorded wrapper holds."""
    if not isinstance(data, dict):
        if hasattr(data, "nearest"):
            return data  # type: ignore[no-any-return]
        raise ConfigurationError(f"expected an obstacle ({', '.join(KINDS)}) or its dict, got {data!r}")
    kind = KINDS.get(data.get("kind", ""))
    if kind is None:
        raise ConfigurationError(
            f"unknown obstacle kind {data.get('kind')!r}; the kinds are {', '.join(KINDS)}"
        )
    obstacle: Obstacle = settings_from(kind, {k: v for k, v in data.items() if k != "kind"}, kind.__name__)
    return obstacle


def obstacles_from(given: Any) -> list[Obstacle]:
    """At least one obstacle, each itself or as its dict."""
    if isinstance(given, dict) or not isinstance(given, Sequence) or not given:
        raise ConfigurationError(f"obstacles is a list with at least one obstacle, got {given!r}")
    return [obstacle_from(o) for o in given]
