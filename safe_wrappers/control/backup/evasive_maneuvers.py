"""Ways of a point mass along evasive manoeuvres: drive in some direction, then brake to rest; and their clearances.

A manoeuvre holds one control along each axis for some control steps, then brakes each axis by itself
(`damped_axis.py`). The result is exact to rounding.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.control.backup.damped_axis import DampedAxis, brake, step
from safe_wrappers.control.compiled import compiled, hypot
from safe_wrappers.errors import Array


@compiled
def ways(
    axes: tuple[DampedAxis, DampedAxis],
    place: Array,
    velocity: Array,
    controls: Array,
    going: NDArray[np.intp],
    instants: NDArray[np.intp],
) -> Array:
    """Positions along each manoeuvre, m, shape (manoeuvres, instants, 2).

    Args:
        axes: Along x and along y.
        place: Shape (2,), m.
        velocity: Shape (2,), m/s.
        controls: With which the manoeuvres go, shape (manoeuvres, 2).
        going: For how many control steps, before they brake, shape (manoeuvres,).
        instants: After how many control steps, ascending.
    """
    found = np.empty((len(going), len(instants), 2))
    for m in range(len(going)):
        for i in range(2):
            x, v, held = place[i], velocity[i], 0
            for k in range(len(instants)):
                while held < instants[k]:
                    x, v = step(axes[i], x, v, controls[m, i] if held < going[m] else brake(axes[i], v))
                    held += 1
                found[m, k, i] = x
    return found


class Around(NamedTuple):
    """What is around a machine on a plane, m; k instants, n boxes.

    Attributes:
        centers, halves: Of the boxes at the instants, shapes (k, n, 2).
        sizes: Distances from the boxes that count as none, shape (n,).
        discs: Rows (x, y, distance from there that counts as none), shape (d, 3).
        planes: Rows (x, y, outward normal's x and y, distance that counts as none), shape (p, 5).
    """

    centers: Array
    halves: Array
    sizes: Array
    discs: Array
    planes: Array


@compiled
def _less(a: float, b: float) -> float:
    """The smaller one; what is not a number stays."""
    return a if a < b or a != a else b


@compiled
def _clearance(x: float, y: float, around: Around, k: int) -> float:
    """Of a place at one of the instants from whatever is nearest, m; inf where there is nothing."""
    nearest = math.inf
    for i in range(len(around.sizes)):
        across = max(abs(x - around.centers[k, i, 0]) - around.halves[k, i, 0], 0.0)
        along = max(abs(y - around.centers[k, i, 1]) - around.halves[k, i, 1], 0.0)
        nearest = _less(nearest, hypot(across, along) - around.sizes[i])
    for disc in around.discs:
        nearest = _less(nearest, hypot(x - disc[0], y - disc[1]) - disc[2])
    for plane in around.planes:
        gap = (x - plane[0]) * plane[2] + (y - plane[1]) * plane[3] - plane[4]
        nearest = _less(nearest, gap)
    return nearest


@compiled
def least_left(places: Array, around: Around, wanted: Array) -> Array:
    """What is left of the clearance that is wanted at the instants, (k,), m, along every way at its worst.

    The ways have the shape (m, k, 2), the result (m,).
    """
    left = np.full(len(places), math.inf)
    for m in range(len(places)):
        for k in range(len(wanted)):
            left[m] = _less(left[m], _clearance(places[m, k, 0], places[m, k, 1], around, k) - wanted[k])
    return left
