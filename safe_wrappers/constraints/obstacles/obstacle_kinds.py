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


def obstacles_from(
    given: Any, name: str = "obstacles", kinds: tuple[type[Any], ...] = (), optional: bool = False
) -> list[Any]:
    """A list of obstacles, each itself or as its dict, of these kinds (none: all); it may be empty if `optional`.

    Raises:
        ConfigurationError: It is no such list; the message names the parameter.
    """
    fitting = " and ".join(kind.__name__ for kind in kinds) or "obstacles"
    if isinstance(given, dict | str) or not isinstance(given, Sequence) or not (given or optional):
        wanted = f"list of {fitting}" if optional else "list with at least one obstacle"
        raise ConfigurationError(f"{name} is a {wanted}, got {given!r}")
    found = [obstacle_from(o) for o in given]
    for obstacle in found:
        if kinds and not isinstance(obstacle, kinds):
            raise ConfigurationError(f"{name} holds {fitting}, got {type(obstacle).__name__}")
    return found
