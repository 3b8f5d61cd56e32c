"""How far ways of points keep from boxes that change with time, and from discs and planes that stand still."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.control.numerics.compiled import compiled, hypot

Array = NDArray[np.float64]


class Around(NamedTuple):
    """What is around a machine on a plane, m; k instants, n boxes.

    Attributes:
        centers, halves: Of the boxes at the instants, shapes (k, n, 2).
        sizes: Distances from the boxes that count as none, shape (n,).
        lowest, highest: Corners of what each box is in at all instants, and now, shapes (n, 2).
        discs: Rows (x, y, distance from there that counts as none, clearance now), shape (d, 4).
        planes: Rows (x, y, outward normal's x and y, distance that counts as none, clearance now), shape (p, 6).
        here: Where the machine is, shape (2,).
    """

    centers: Array
    halves: Array
    sizes: Array
    lowest: Array
    highest: Array
    discs: Array
    planes: Array
    here: Array


@compiled
def way_clearances(x: Array, y: Array, around: Around, margin: float) -> Array:
    """Distances of ways, shapes (c, m, k) as their coordinates, from whatever is nearest; inf far from everything.

    Far is what no way comes nearer to than the margin. What is not a number stays.
    """
    nearest = np.full(x.shape, math.inf)
    left, right, low, high = x.min(), x.max(), y.min(), y.max()
    for i in range(around.sizes.size):
        room = around.sizes[i] + margin
        lowest, highest = around.lowest[i], around.highest[i]
        across = lowest[0] - room <= right and highest[0] + room >= left
        if across and lowest[1] - room <= high and highest[1] + room >= low:
            _from_box(x, y, around.centers[:, i], around.halves[:, i], around.sizes[i], nearest)
    here_x, here_y = around.here[0], around.here[1]
    reach = hypot(max(right - here_x, here_x - left), max(high - here_y, here_y - low))
    for disc in around.discs:
        if disc[3] - reach <= margin:
            for at in np.ndindex(x.shape):
                across, along = x[at] - disc[0], y[at] - disc[1]
                gap = math.sqrt(across * across + along * along) - disc[2]
                if gap < nearest[at] or gap != gap:
                    nearest[at] = gap
    for plane in around.planes:
        if plane[5] - reach <= margin:
            for at in np.ndindex(x.shape):
                gap = (x[at] - plane[0]) * plane[2] + (y[at] - plane[1]) * plane[3] - plane[4]
                if gap < nearest[at] or gap != gap:
                    nearest[at] = gap
    return nearest


@compiled
def _from_box(x: Array, y: Array, center: Array, half: Array, size: float, nearest: Array) -> None:
    """Take the distances from a box into account; centres and half-widths (k, 2)."""
    for c, m, k in np.ndindex(x.shape):
        across = max(abs(x[c, m, k] - center[k, 0]) - half[k, 0], 0.0)
        along = max(abs(y[c, m, k] - center[k, 1]) - half[k, 1], 0.0)
        gap = math.sqrt(across * across + along * along) - size
        if gap < nearest[c, m, k] or gap != gap:
            nearest[c, m, k] = gap


@compiled
def least_left(clearances: Array, wanted: Array) -> Array:
    """What is left of what is wanted at the instants, (k,), along every way at its worst, shape (c, m)."""
    left = np.full(clearances.shape[:2], math.inf)
    for c in range(clearances.shape[0]):
        for m in range(clearances.shape[1]):
            for k in range(wanted.size):
                over = clearances[c, m, k] - wanted[k]
                if over < left[c, m] or over != over:
                    left[c, m] = over
    return left
