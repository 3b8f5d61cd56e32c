"""Obstacles as plain data, so that a constraint that holds them can be recorded and rebuilt."""

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

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
    return kind(**{k: v for k, v in data.items() if k != "kind"})  # type: ignore[no-any-return]


def obstacles_from(
    given: Any, name: str = "obstacles", kinds: tuple[type[Any], ...] = (), optional: bool = False
) -> list[Any]:
    """A list of obstacles, each itself or as its dict.

    Args:
        given: What the user gave.
        name: Of the parameter, for messages.
        kinds: Of obstacles that fit; none: all.
        optional: Whether the list may be empty.

    Raises:
        ConfigurationError: It is no such list.
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


def obstacle_data(obstacle: Any) -> Any:
    """The plain dict of an obstacle of ours, or a foreign obstacle as it is."""
    kind = KINDS.get(type(obstacle).__name__)
    if kind is not type(obstacle):
        return obstacle
    return {"kind": kind.__name__, **{f.name: getattr(obstacle, f.name) for f in fields(kind)}}
