"""Marks: shapes that a constraint draws of itself, as plain data in world coordinates. Nothing here draws."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array

Role = Literal["keep out", "limit", "way", "estimate", "proposed", "executed"]
Shape = Literal["sphere", "capsule", "box", "arrow"]

_CORNERS: Final = 16
THIN: Final = 0.012
"""m: half the width of a line."""
FLOOR: Final = 0.02
"""m: the height at which what has no height is drawn, just above a floor at 0."""
COLOURS: Final[dict[Role, tuple[float, float, float, float]]] = {
    "keep out": (0.95, 0.15, 0.1, 0.4),
    "limit": (0.95, 0.15, 0.1, 0.9),
    "way": (1.0, 0.72, 0.05, 0.95),
    "estimate": (0.55, 0.3, 0.8, 0.35),
    "proposed": (0.95, 0.42, 0.1, 1.0),
    "executed": (0.1, 0.45, 0.9, 1.0),
}
"""Red, green, blue and opacity, from 0 to 1. What is forbidden is faint, the edge of what is allowed is not."""


@dataclass(frozen=True, eq=False)
class Mark:
    """One shape.

    Attributes:
        shape: Which one.
        role: What it says, which is its colour.
        position: Of its centre, of an arrow's tail, shape (3,), m.
        size: Shape (3,), m, as `mujoco.mjv_initGeom` takes it: radius (and half length) of what is round, half sizes
            along its axes of a box; of an arrow twice its radius, then its length.
        axes: Its own x, y and z axis in the world, as columns, shape (3, 3); what is long is along z.
    """

    shape: Shape
    role: Role
    position: Array
    size: Array
    axes: Array

    @property
    def tip(self) -> Array:
        """Where an arrow ends, shape (3,), m."""
        return np.asarray(self.position + self.size[2] * self.axes[:, 2])


def _mark(shape: Shape, role: Role, at: Array, size: Sequence[float], axes: Array | None = None) -> Mark:
    return Mark(shape, role, at, np.array(size, dtype=np.float64), np.eye(3) if axes is None else axes)


def spatial(point: ArrayLike, height: float = FLOOR) -> Array:
    """A point of one to three coordinates in space: what it lacks is 0, but the height is given, m."""
    given = np.asarray(point, dtype=np.float64)
    whole = np.array([0.0, 0.0, height])
    whole[: given.size] = given
    return whole


def ball(role: Role, center: ArrayLike, radius: float) -> Mark:
    """A ball about a point, m."""
    return _mark("sphere", role, spatial(center), [radius, 0.0, 0.0])


def ring(role: Role, center: ArrayLike, radius: float) -> list[Mark]:
    """A circle on the floor, m, as a polygon of thin boxes: of many rings, round rods would cost most of a frame."""
    angles = np.linspace(0.0, 2.0 * np.pi, _CORNERS + 1)
    around = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    corners = [spatial(point) for point in spatial(center)[:2] + radius * around]
    return [
        _mark("box", role, (a + b) / 2.0, [THIN, THIN, float(np.linalg.norm(b - a)) / 2.0], _frame(b - a))
        for a, b in pairwise(corners)
    ]


def block(role: Role, center: ArrayLike, half_size: ArrayLike) -> Mark:
    """A box along the world's axes, m; what has no height stands on the floor."""
    return _mark("box", role, spatial(center), spatial(half_size).tolist())


def pad(role: Role, foot: ArrayLike, normal: ArrayLike, half_size: float) -> Mark:
    """A thin square of a plane around a point of it, m."""
    thin = 0.002 + 0.005 * half_size
    return _mark("box", role, spatial(foot), [half_size, half_size, thin], _frame(spatial(normal, 0.0)))


def segment(role: Role, start: ArrayLike, end: ArrayLike, radius: float) -> Mark:
    """A rod with round ends between two points, m."""
    tail, tip = spatial(start), spatial(end)
    length = float(np.linalg.norm(tip - tail))
    return _mark("capsule", role, (tail + tip) / 2.0, [radius, length / 2.0, 0.0], _frame(tip - tail))


def line(role: Role, points: Sequence[ArrayLike] | Array, radius: float, closed: bool = False) -> list[Mark]:
    """Rods from each point to the next one, and back to the first if `closed`, m."""
    ends = [*points[1:], points[0]] if closed else points[1:]
    return [segment(role, a, b, radius) for a, b in zip(points, ends, strict=False)]


def arrow(role: Role, tail: ArrayLike, vector: ArrayLike, radius: float) -> Mark:
    """An arrow from a point along a vector, m."""
    along = spatial(vector, 0.0)
    size = [radius, radius, float(np.linalg.norm(along))]
    return _mark("arrow", role, spatial(tail), size, _frame(along))


def edges(role: Role, low: Array, high: Array, radius: float) -> list[Mark]:
    """The twelve edges of a box between two corners, shape (3,), m."""
    found = []
    for axis in range(3):
        others = [i for i in range(3) if i != axis]
        for one in (low, high):
            for other in (low, high):
                start = np.array(low, dtype=np.float64)
                start[others[0]], start[others[1]] = one[others[0]], other[others[1]]
                end = start.copy()
                end[axis] = high[axis]
                found.append(segment(role, start, end, radius))
    return found


def _frame(along: Array) -> Array:
    """Axes whose z is along a vector, as columns; a vector of no length has the world's."""
    length = float(np.linalg.norm(along))
    if length < 1e-12:
        return np.eye(3)
    z = along / length
    aside = np.eye(3)[int(np.abs(z).argmin())]
    x = np.cross(aside, z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)
