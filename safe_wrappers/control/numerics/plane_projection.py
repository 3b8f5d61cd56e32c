"""Projection of a pair of numbers onto half-planes and a box: every pair of active bounds is tried.

At most a dozen bounds are in play, so trying all of them beats any iteration.
"""

import math

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.control.numerics.compiled import compiled

_PARALLEL = 1e-12
"""Sine of the angle between two bounds below which their crossing is not looked for."""


@compiled
def _violated(x: float, y: float, normals: Array, offsets: Array, slack: float) -> bool:
    for i in range(offsets.size):
        length = math.sqrt(normals[i, 0] * normals[i, 0] + normals[i, 1] * normals[i, 1])
        if not normals[i, 0] * x + normals[i, 1] * y - offsets[i] <= slack * length:
            return True
    return False


@compiled
def project_in_plane(
    u: Array, normals: Array, offsets: Array, low: Array, high: Array, slack: float, out: Array
) -> bool:
    """The point closest to `u` with `normals @ x <= offsets` and `low <= x <= high`.

    Args:
        u: Shape (2,).
        normals: Shape (k, 2); their lengths are units of the offsets per unit of x.
        offsets: Shape (k,).
        low: Box, shape (2,).
        high: Box, shape (2,).
        slack: Distance by which an answer may break a row, in units of x.
        out: The answer, shape (2,); left alone if there is none.

    Returns:
        Whether there is such a point.
    """
    k = offsets.size
    all_normals, all_offsets = np.zeros((k + 4, 2)), np.zeros(k + 4)
    for i in range(k):
        all_normals[i, 0], all_normals[i, 1], all_offsets[i] = normals[i, 0], normals[i, 1], offsets[i]
    for j in range(2):
        all_normals[k + 2 * j, j], all_offsets[k + 2 * j] = 1.0, high[j]
        all_normals[k + 2 * j + 1, j], all_offsets[k + 2 * j + 1] = -1.0, -low[j]
    if not _violated(u[0], u[1], all_normals, all_offsets, slack):
        out[0], out[1] = u[0], u[1]
        return True
    best, found, n = math.inf, False, k + 4
    best_x, best_y = u[0], u[1]
    for i in range(n):
        a, b, c = all_normals[i, 0], all_normals[i, 1], all_offsets[i]
        square = a * a + b * b
        if not (square > 0.0 and a * u[0] + b * u[1] >= c):
            continue  # the closest point lies on a bound that u breaks, or where one of those meets another
        for j in range(n):
            if j == i:
                share = (c - a * u[0] - b * u[1]) / square
                x, y = u[0] + share * a, u[1] + share * b
            else:
                d, e, f = all_normals[j, 0], all_normals[j, 1], all_offsets[j]
                cross = a * e - b * d
                if not abs(cross) > _PARALLEL * math.sqrt(square * (d * d + e * e)):
                    continue
                x, y = (c * e - b * f) / cross, (a * f - c * d) / cross
            away = (x - u[0]) * (x - u[0]) + (y - u[1]) * (y - u[1])
            if away < best and not _violated(x, y, all_normals, all_offsets, slack):
                best, best_x, best_y, found = away, x, y, True
    if found:
        out[0] = min(max(best_x, low[0]), high[0])
        out[1] = min(max(best_y, low[1]), high[1])
    return found
