"""Positions of a point mass along evasive manoeuvres: drive in some direction, then brake to rest.

A manoeuvre holds one control along each axis for some control steps (the drive phase), then brakes each axis
separately (`damped_axis.py`), which is tabulated once. The result is exact to rounding.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array
from safe_wrappers.control.backup.damped_axis import DampedAxis, brake
from safe_wrappers.control.numerics.compiled import compiled

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
