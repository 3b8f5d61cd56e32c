"""The discs nearest to a moving frame in the plane, as bounded numbers for a learner."""

import math

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.control.numerics.compiled import compiled, hypot

NUMBERS = 4
"""Per disc."""


@compiled
def squashed(value: float, scale: float) -> float:
    """From a number of any size to one in [-1, 1], monotone; slope 1 / scale at 0, and +-0.5 at +-scale."""
    return math.copysign(1.0, value) if math.isinf(value) else value / (scale + abs(value))


@compiled
def nearest_discs(
    discs: NDArray[np.float64], x: float, y: float, heading: float, vx: float, vy: float, count: int
) -> NDArray[np.float64]:
    """The nearest discs as seen from a frame, the nearest first.

    Args:
        discs: Centre and radius of each, m, shape (n, 3).
        x: Of the frame's origin, m.
        y: Likewise.
        heading: Of its x axis, rad.
        vx: Velocity of its origin, m/s.
        vy: Likewise.
        count: How many; where there are fewer, the rest is far away.

    Returns:
        Shape (4 * count,), in [-1, 1]: of each the direction of its centre ahead and to the left (a unit vector), its
        clearance from the origin (1 m is 0.5) and the speed at which the origin closes in (1 m/s is 0.5).
    """
    seen = np.zeros(NUMBERS * count)
    ahead_x, ahead_y = math.cos(heading), math.sin(heading)
    taken = np.zeros(len(discs), dtype=np.bool_)
    for place in range(count):
        best, least = -1, math.inf
        for i in range(len(discs)):
            clearance = hypot(discs[i, 0] - x, discs[i, 1] - y) - discs[i, 2]
            if not taken[i] and clearance < least:
                best, least = i, clearance
        seen[NUMBERS * place + 2] = 1.0
        if best < 0:
            continue
        taken[best] = True
        to_x, to_y = discs[best, 0] - x, discs[best, 1] - y
        distance = hypot(to_x, to_y)
        if distance > 0.0:
            to_x, to_y = to_x / distance, to_y / distance
        seen[NUMBERS * place] = to_x * ahead_x + to_y * ahead_y
        seen[NUMBERS * place + 1] = to_y * ahead_x - to_x * ahead_y
        seen[NUMBERS * place + 2] = squashed(least, 1.0)
        seen[NUMBERS * place + 3] = squashed(vx * to_x + vy * to_y, 1.0)
    return seen
