"""A point mass on two axes among rectangular walls: its way until rest, and the distances of a way from the walls.

The point holds a control for one control step, or none, and then brakes each axis by itself (`damped_axis.py`).
Positions are those of the physics steps; between two of them the rectangle that they span counts.
"""

import math
from typing import Final

import numpy as np

from safe_wrappers.control.backup.damped_axis import DampedAxis, brake, clipped
from safe_wrappers.control.compiled import compiled, hypot
from safe_wrappers.errors import Array

MOST_HOLDS: Final = 4096
"""Control steps to rest; a way that takes more has no end."""
_AT_REST: Final = 1e-12
"""m/s; slower is rest."""
_HALVINGS: Final = 24
"""Of the way between braking and the control that was asked for, along one axis."""


@compiled
def _holds_to_rest(axis: DampedAxis, v: float) -> int:
    """Control steps of braking, at most `MOST_HOLDS`."""
    holds = 0
    while abs(v) > _AT_REST and holds < MOST_HOLDS:
        v = axis.keep * v + axis.add * brake(axis, v)
        holds += 1
    return holds


@compiled
def way(axes: tuple[DampedAxis, DampedAxis], place: Array, velocity: Array, held: Array) -> Array:
    """Positions at every physics step until rest, the present one first, m, shape (instants, 2).

    Args:
        axes: Along x and along y.
        place: Shape (2,), m.
        velocity: Shape (2,), m/s.
        held: The controls of the first control steps, shape (holds, 2); braking comes after them.

    Returns:
        At least two instants. Where there is no rest within `MOST_HOLDS`, the last position is not a number.
    """
    longest = 1
    for i in range(2):
        v = clipped(axes[i], velocity[i])
        for k in range(len(held)):
            v = axes[i].keep * v + axes[i].add * max(axes[i].low, min(held[k, i], axes[i].high))
            v = clipped(axes[i], v)
        longest = max(longest, len(held) + _holds_to_rest(axes[i], v))
    substeps = axes[0].substeps
    places = np.empty((longest * substeps + 1, 2))
    for i in range(2):
        # A velocity that is not a number makes the place one, too: the clip would hide it.
        axis, x, v = axes[i], place[i] + 0.0 * velocity[i], velocity[i]
        places[0, i] = x
        for k in range(longest):
            v = clipped(axis, v)
            u = max(axis.low, min(held[k, i], axis.high)) if k < len(held) else brake(axis, v)
            for j in range(substeps):
                v = axis.decay * v + axis.gain * u
                x += axis.timestep * v
                places[k * substeps + j + 1, i] = x
        if abs(v) > _AT_REST and longest >= MOST_HOLDS:
            places[-1, i] = math.nan
    return places


@compiled
def distances(places: Array, walls: Array, whole: bool) -> Array:
    """Signed distances of a way from walls, m, shape (parts of the way, k).

    A part is the rectangle that two successive positions span. Its distance is Euclidean outside of a wall, and where
    they overlap, minus the shortest translation along an axis that separates them.

    Args:
        places: Shape (instants, 2), m. If one is not finite, no distance is a number.
        walls: Rectangles x from, x to, y from, y to, m, shape (k, 4).
        whole: The first part is the rectangle around the way, the last one its end.
    """
    corners = places
    if whole:
        corners = np.empty((4, 2))
        for i in range(2):
            corners[0, i], corners[1, i] = places[:, i].min(), places[:, i].max()
        corners[2:] = places[-1]
    apart = np.full((len(corners) - 1, len(walls)), math.nan)
    if not math.isfinite(places.sum()):
        return apart
    for i in range(len(corners) - 1):
        x, y, to_x, to_y = corners[i, 0], corners[i, 1], corners[i + 1, 0], corners[i + 1, 1]
        left, right, lower, upper = min(x, to_x), max(x, to_x), min(y, to_y), max(y, to_y)
        for k in range(len(walls)):
            across = max(left - walls[k, 1], walls[k, 0] - right)
            along = max(lower - walls[k, 3], walls[k, 2] - upper)
            apart[i, k] = hypot(across, along) if across > 0.0 and along > 0.0 else max(across, along)
    return apart


@compiled
def slides(
    axes: tuple[DampedAxis, DampedAxis],
    place: Array,
    velocity: Array,
    asked: Array,
    walls: Array,
    room: float,
    whole: bool,
) -> Array:
    """Two controls that keep a distance `room` from the walls, where braking does, shape (2, 2).

    Each begins with braking and takes over as much as it can of the control that was asked for, shape (2,), along one
    axis after the other: the first along x first, the second along y.
    """
    found = np.empty((2, 1, 2))
    for first in range(2):
        control = found[first]
        for i in range(2):
            control[0, i] = brake(axes[i], clipped(axes[i], velocity[i]))
        for i in (first, 1 - first):
            kept, tried = control[0, i], asked[i]
            refused = tried
            for _ in range(_HALVINGS):
                control[0, i] = tried
                if distances(way(axes, place, velocity, control), walls, whole).min() >= room:
                    kept = tried
                else:
                    refused = tried
                if kept == asked[i]:
                    break
                tried = 0.5 * (kept + refused)
            control[0, i] = kept
    return found[:, 0]
