"""Positions of a point mass along evasive manoeuvres: drive in some direction, then brake to rest; and clearances.

A manoeuvre holds one control along each axis for some control steps (the drive phase), then brakes each axis
separately (`damped_axis.py`), which is tabulated once. The result is exact to rounding.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array
from safe_wrappers.control.backup.damped_axis import DampedAxis, brake
from safe_wrappers.control.numerics.compiled import compiled, hypot

_FASTEST_M_S = 50.0
"""Speeds up to this one are tabulated."""


class Maneuver(NamedTuple):
    """Controls along x and y, as shares (-1 to 1) of the limit in that direction, and how many holds they last."""

    x: float
    y: float
    holds: int


class _Braking(NamedTuple):
    """Displacement of braking for one direction of motion: knots of speed (k,), m/s, and ways (k, holds + 1), m."""

    speeds: Array
    ways: Array


class Prepared(NamedTuple):
    """Drive phases as maps of an axis's speed, and the braking after them; m manoeuvres, k instants."""

    drift: Array
    shift: Array
    keep: Array
    add: Array
    after: NDArray[np.intp]
    forwards: _Braking
    backwards: _Braking


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
        x, y = (self._prepared(axis, self.controls[:, i]) for i, axis in enumerate(axes))
        self.prepared = x, y
        """For `ways`."""

    def _prepared(self, axis: DampedAxis, controls: Array) -> Prepared:
        n = int(self.instants[-1])
        keep, add = np.ones(n + 1), np.zeros(n + 1)  # speed after k holds, per speed and per control
        drift, shift = np.zeros(n + 1), np.zeros(n + 1)  # and the displacement
        for k in range(n):
            keep[k + 1], add[k + 1] = axis.keep * keep[k], axis.keep * add[k] + axis.add
            drift[k + 1] = drift[k] + axis.drift * keep[k]
            shift[k + 1] = shift[k] + axis.drift * add[k] + axis.shift
        steps = np.minimum(self.instants, self._going[:, None])  # holds of the drive phase completed by then
        return Prepared(
            drift[steps],
            shift[steps] * controls[:, None],
            keep[self._going],
            add[self._going] * controls,
            self.instants - steps,
            _braking(axis, -axis.low, n),
            _braking(axis, axis.high, n),
        )

    def paths(self, position: Array, velocity: Array, which: NDArray[np.intp]) -> tuple[Array, Array]:
        """Positions along x and along y at the instants, shape (c, m, instants) each, m.

        Args:
            position: Shape (c, 2), m.
            velocity: Shape (c, 2), m/s.
            which: Indices of manoeuvres, shape (m,).
        """
        return ways(self.prepared, position, velocity, which)

    def first(self, which: int, velocity: Array) -> Array:
        """The control of a manoeuvre's first hold from a velocity (2,), shape (2,)."""
        if self._going[which]:
            return np.array(self.controls[which])
        return np.array([brake(axis, float(v)) for axis, v in zip(self._axes, velocity, strict=True)])


@compiled
def ways(
    prepared: tuple[Prepared, Prepared], position: Array, velocity: Array, which: NDArray[np.intp]
) -> tuple[Array, Array]:
    """As `EvasiveManeuvers.paths`, which says what the arguments are."""
    count, instants = which.size, prepared[0].after.shape[1]
    x, y = np.empty((len(position), count, instants)), np.empty((len(position), count, instants))
    for c in range(len(position)):
        for m in range(count):
            _way(prepared[0], position[c, 0], velocity[c, 0], which[m], x[c, m])
            _way(prepared[1], position[c, 1], velocity[c, 1], which[m], y[c, m])
    return x, y


@compiled
def _way(p: Prepared, start: float, speed: float, which: int, way: Array) -> None:
    """Write one manoeuvre's positions along an axis."""
    end = p.keep[which] * speed + p.add[which]  # the speed at which braking begins
    table = p.forwards if end >= 0.0 else p.backwards
    speeds, size = table.speeds, abs(end)
    low, high = 1, speeds.size - 1
    while low < high:  # the first knot beyond, or the last one
        middle = (low + high) // 2
        if size < speeds[middle]:
            high = middle
        else:
            low = middle + 1
    share = (size - speeds[low - 1]) / (speeds[low] - speeds[low - 1])
    direction = 1.0 if end >= 0.0 else -1.0
    for k in range(way.size):
        holds = p.after[which, k]
        before, behind = table.ways[low - 1, holds], table.ways[low, holds]
        gone = p.drift[which, k] * speed + p.shift[which, k]
        way[k] = start + (gone + direction * (before + share * (behind - before)))


def _braking(axis: DampedAxis, brake: float, holds: int) -> _Braking:
    """Table for one direction of motion, braked by a control of size `brake`."""
    loss, lost_way = axis.add * brake, axis.shift * brake
    # Displacement of the last hold, which ends at rest.
    per_speed = axis.drift - axis.shift * axis.keep / axis.add
    speeds, ways = [0.0], [np.zeros(holds + 1)]
    speed = loss / axis.keep
    while speeds[-1] < _FASTEST_M_S:
        first = axis.drift * speed - lost_way if len(speeds) > 1 else per_speed * speed
        way = np.empty(holds + 1)
        way[0], way[1:] = 0.0, first + ways[-1][:-1]
        speeds.append(speed)
        ways.append(way)
        speed = (speed + loss) / axis.keep
    return _Braking(np.array(speeds), np.array(ways))


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
