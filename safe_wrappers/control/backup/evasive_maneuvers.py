"""Positions of a point mass along evasive manoeuvres: drive in some direction, then brake to rest.

A manoeuvre holds one control along each axis for some control steps (the drive phase), then brakes each axis
separately (`damped_axis.py`), which is tabulated once. The result is exact to rounding.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.control.backup.damped_axis import DampedAxis, brake

Array = NDArray[np.float64]

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

    def at(self, speed: Array, holds: NDArray[np.intp]) -> Array:
        """Displacements for speeds (c, m) >= 0 after the given holds (m, k), shape (c, m, k)."""
        last = len(self.speeds) - 1
        i = np.minimum(np.maximum(self.speeds.searchsorted(speed, side="right"), 1), last)
        low, high = self.speeds[i - 1], self.speeds[i]
        share = ((speed - low) / (high - low))[..., None]
        before, behind = self.ways[(i - 1)[..., None], holds], self.ways[i[..., None], holds]
        return np.asarray(before + share * (behind - before))


class _Prepared(NamedTuple):
    """Drive phases as maps of an axis's speed, and the braking after them; m manoeuvres, k instants."""

    drift: Array
    shift: Array
    keep: Array
    add: Array
    after: NDArray[np.intp]
    forwards: _Braking
    backwards: _Braking
    symmetric: bool


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
        self._parts = [self._prepared(axis, self.controls[:, i]) for i, axis in enumerate(axes)]

    def _prepared(self, axis: DampedAxis, controls: Array) -> _Prepared:
        n = int(self.instants[-1])
        keep, add = np.ones(n + 1), np.zeros(n + 1)  # speed after k holds, per speed and per control
        drift, shift = np.zeros(n + 1), np.zeros(n + 1)  # and the displacement
        for k in range(n):
            keep[k + 1], add[k + 1] = axis.keep * keep[k], axis.keep * add[k] + axis.add
            drift[k + 1] = drift[k] + axis.drift * keep[k]
            shift[k + 1] = shift[k] + axis.drift * add[k] + axis.shift
        steps = np.minimum(self.instants, self._going[:, None])  # holds of the drive phase completed by then
        return _Prepared(
            drift[steps],
            shift[steps] * controls[:, None],
            keep[self._going],
            add[self._going] * controls,
            self.instants - steps,
            _braking(axis, -axis.low, n),
            _braking(axis, axis.high, n),
            axis.high == -axis.low,
        )

    def paths(self, position: Array, velocity: Array, which: NDArray[np.intp]) -> tuple[Array, Array]:
        """Positions along x and along y at the instants, shape (c, m, instants) each, m.

        Args:
            position: Shape (c, 2), m.
            velocity: Shape (c, 2), m/s.
            which: Indices of manoeuvres, shape (m,).
        """
        along = []
        for i, p in enumerate(self._parts):
            v = velocity[:, i, None]
            end = p.keep[which] * v + p.add[which]  # (c, m): the speed at which braking begins
            after = p.after[which]
            if p.symmetric:
                braked = np.sign(end)[..., None] * p.forwards.at(np.abs(end), after)
            else:
                ahead, back = np.maximum(end, 0.0), np.maximum(-end, 0.0)
                braked = p.forwards.at(ahead, after) - p.backwards.at(back, after)
            gone = p.drift[which] * v[..., None] + p.shift[which]
            along.append(position[:, i, None, None] + (gone + braked))
        return along[0], along[1]

    def first(self, which: int, velocity: Array) -> Array:
        """The control of a manoeuvre's first hold from a velocity (2,), shape (2,)."""
        if self._going[which]:
            return np.array(self.controls[which])
        return np.array([brake(axis, float(v)) for axis, v in zip(self._axes, velocity, strict=True)])


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
