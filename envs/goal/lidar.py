"""Pseudo-lidar: how near the nearest object of each kind is, by direction, without casting rays."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array

LIDAR_BINS: Final = 16
"""Directions per object kind; bin i spans [i, i + 1] * 2 pi / 16 counter-clockwise from straight ahead."""
LIDAR_RANGE: Final = 3.0
"""Distance from which on an object reads 0, m."""

_NEIGHBOURS: Final = np.array([[0], [1], [-1]])


def pseudo_lidar(
    relative: Array,
    kinds: NDArray[np.intp],
    n_kinds: int,
    bins: int = LIDAR_BINS,
    max_dist: float = LIDAR_RANGE,
) -> Array:
    """Read the lidars of all object kinds at once.

    An object at distance d in bin i reads s = max(0, 1 - d / max_dist) there. It also reads into both
    neighbours, so that the picture changes smoothly as it crosses a border: with a in [0, 1) its place inside
    the bin, bin i + 1 gets a * s and bin i - 1 gets (1 - a) * s. Each bin keeps its largest reading.

    Args:
        relative: Object centres in the robot's frame (x ahead, y to the left), shape (n, 2), m.
        kinds: Kind of each object, shape (n,), in [0, n_kinds).
        n_kinds: Number of kinds.
        bins: Directions per kind.
        max_dist: Range, m.

    Returns:
        Readings in [0, 1], shape (n_kinds * bins,), one kind after the other.
    """
    readings = np.zeros(n_kinds * bins)
    strength = np.maximum(0.0, max_dist - np.hypot(relative[:, 0], relative[:, 1])) / max_dist
    sector = np.arctan2(relative[:, 1], relative[:, 0]) % (2 * np.pi) / (2 * np.pi / bins)
    index = sector.astype(np.intp)
    place = sector - index
    # The modulo also catches an angle just below zero, whose remainder rounds up to a full turn.
    target = (index + _NEIGHBOURS) % bins + kinds * bins
    np.maximum.at(readings, target, np.stack([strength, place * strength, (1 - place) * strength]))
    return readings
