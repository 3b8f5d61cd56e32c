"""Positions of a point mass along evasive manoeuvres: drive in some direction, then brake to rest; and clearances.

A manoeuvre holds one control along each axis for some control steps (the drive phase), then brakes each axis
separately (`damped_axis.py`). The result is exact to rounding.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.control.backup.damped_axis import DampedAxis, brake, step
from safe_wrappers.control.compiled import compiled, hypot
from safe_wrappers.errors import Array


class Maneuver(NamedTuple):
    """Controls along x and y, as shares (-1 to 1) of the limit in that direction, and how many holds they last."""

    x: float
    y: float
    holds: int


class EvasiveManeuvers:
    """A set of manoeuvres along both axes.

    Args:
        axes: Constants of the motion along x and y.
        manoeuvres: At least one.
        instants: Numbers of holds after which positions are returned, ascending.
    """

    def __init__(
        self, axes: tuple[DampedAxis, DampedAxis], manoeuvres: list[Maneuver], instants: NDArray[np.intp]
    ) -> None:
        self.manoeuvres = manoeuvres
        self.instants = instants
        self._axes = axes
        shares = np.array([(m.x, m.y) for m in manoeuvres])
        forwards, backwards = np.array([axis.high for axis in axes]), np.array([-axis.low for axis in axes])
        self.controls = shares * np.where(shares > 0.0, forwards, backwards)
        """Of the drive phases, shape (manoeuvres, 2)."""
        self._going = np.array([m.holds for m in manoeuvres])

    def paths(self, position: Array, velocity: Array, which: NDArray[np.intp]) -> tuple[Array, Array]:
        """Positions along x and along y at the instants, shape (c, m, instants) each, m.

        Args:
            position: Shape (c, 2), m.
            velocity: Shape (c, 2), m/s.
            which: Indices of manoeuvres, shape (m,).
        """
        starts, speeds, controls = (part.T.copy() for part in (position, velocity, self.controls[which]))
        of_all = self._going[which], self.instants
        x, y = (_ways(self._axes[i], starts[i], speeds[i], controls[i], *of_all) for i in range(2))
        return x, y

    def first(self, which: int, velocity: Array) -> Array:
        """The control of a manoeuvre's first hold from a velocity (2,), shape (2,)."""
        if self._going[which]:
            return np.array(self.controls[which])
        return np.array([brake(axis, float(v)) for axis, v in zip(self._axes, velocity, strict=True)])


@compiled
def _ways(
    axis: DampedAxis,
    starts: Array,
    speeds: Array,
    controls: Array,
    going: NDArray[np.intp],
    instants: NDArray[np.intp],
) -> Array:
    """Positions along one axis, m, from each start and by each manoeuvre at the instants, shape (c, m, instants)."""
    ways = np.empty((len(starts), len(controls), len(instants)))
    for c in range(len(starts)):
        for m in range(len(controls)):
            x, v, held = starts[c], speeds[c], 0
            for k in range(len(instants)):
                while held < instants[k]:
                    x, v = step(axis, x, v, controls[m] if held < going[m] else brake(axis, v))
                    held += 1
                ways[c, m, k] = x
    return ways


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
def least_left(x: Array, y: Array, around: Around, wanted: Array) -> Array:
    """What is left of the clearance that is wanted at the instants, (k,), m, along every way at its worst.

    The ways' coordinates have the shape (c, m, k), the result (c, m).
    """
    left = np.full(x.shape[:2], math.inf)
    for c in range(x.shape[0]):
        for m in range(x.shape[1]):
            for k in range(len(wanted)):
                left[c, m] = _less(left[c, m], _clearance(x[c, m, k], y[c, m, k], around, k) - wanted[k])
    return left
