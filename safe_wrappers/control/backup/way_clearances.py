"""How far ways of points keep from boxes that change with time, and from discs and planes that stand still."""

import math
from typing import NamedTuple

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.control.numerics.compiled import compiled, hypot


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

    Far is what no way comes nearer to than the margin.
    """
    nearest = np.full(x.shape, math.inf)
    left, right, low, high = x.min(), x.max(), y.min(), y.max()
    for i in range(around.sizes.size):
        room = around.sizes[i] + margin
        lowest, highest = around.lowest[i], around.highest[i]
        across = lowest[0] - room <= right and highest[0] + room >= left
        if across and lowest[1] - room <= high and highest[1] + room >= low:
            _from_box(x, y, around.centers[:, i].copy(), around.halves[:, i].copy(), around.sizes[i], nearest)
    here_x, here_y = around.here[0], around.here[1]
    reach = hypot(max(right - here_x, here_x - left), max(high - here_y, here_y - low))
    flat_x, flat_y, flat = x.reshape(-1), y.reshape(-1), nearest.reshape(-1)
    for disc in around.discs:
        if disc[3] - reach <= margin:
            for i in range(flat.size):
                across, along = flat_x[i] - disc[0], flat_y[i] - disc[1]
                gap = math.sqrt(across * across + along * along) - disc[2]
                flat[i] = gap if gap < flat[i] else flat[i]
    for plane in around.planes:
        if plane[5] - reach <= margin:
            for i in range(flat.size):
                gap = (flat_x[i] - plane[0]) * plane[2] + (flat_y[i] - plane[1]) * plane[3] - plane[4]
                flat[i] = gap if gap < flat[i] else flat[i]
    return nearest


@compiled
def _from_box(x: Array, y: Array, center: Array, half: Array, size: float, nearest: Array) -> None:
    """Take the distances from a box into account; centres and half-widths (k, 2)."""
    ahead_x, ahead_y = center[:, 0].copy(), center[:, 1].copy()
    half_x, half_y = half[:, 0].copy(), half[:, 1].copy()
    for c in range(x.shape[0]):
        for m in range(x.shape[1]):
            for k in range(x.shape[2]):
                across = max(abs(x[c, m, k] - ahead_x[k]) - half_x[k], 0.0)
                along = max(abs(y[c, m, k] - ahead_y[k]) - half_y[k], 0.0)
                gap = math.sqrt(across * across + along * along) - size
                nearest[c, m, k] = gap if gap < nearest[c, m, k] else nearest[c, m, k]


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
