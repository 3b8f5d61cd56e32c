"""Things to keep clear of: discs, spheres, boxes and planes; what moves is published by the env (`Discs`).

They are plain data, so that a wrapper that is given obstacles can be recorded and rebuilt.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from safe_wrappers.checks import positive
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.constraint import Array
from safe_wrappers.plants.plant import Plant


class Nearest(NamedTuple):
    """For one point and k surfaces in d dimensions.

    Attributes:
        distance: Signed, m, negative inside, shape (k,).
        normal: Unit vectors from the surface towards the point, shape (k, d).
        velocity: Of the surface, m/s, shape (k, d).
        curvature: Of the surface of equal distance through the point, along each coordinate, 1/m, shape
            (k, d): what a sideways motion gains in clearance. Zero along an edge or an upright cylinder.
    """

    distance: Array
    normal: Array
    velocity: Array
    curvature: Array


class Obstacle(Protocol):
    """Anything with a nearest surface. Ours also have `distances`, for many points at once."""

    def nearest(self, point: Array, plant: Plant) -> Nearest:
        """The surfaces of this obstacle as seen from a point of shape (d,)."""


def distances(obstacle: Obstacle, points: Array, plant: Plant) -> Array:
    """Signed distances of points of shape (k, d) to an obstacle's n surfaces, shape (k, n), m."""
    together = getattr(obstacle, "distances", None)
    if together is not None:
        return np.asarray(together(points, plant))
    return np.stack([obstacle.nearest(point, plant).distance for point in points])


def refuse_more_dimensions(obstacle: int, point: int, kind: str = "obstacles") -> None:
    """Refuse an obstacle of more dimensions than the point that is kept clear of it."""
    if obstacle > point:
        raise ConfigurationError(f"{obstacle}-dimensional {kind} cannot meet a {point}-dimensional point")


def _vector(name: str, values: Sequence[float], sizes: tuple[int, ...]) -> list[float]:
    try:
        vector = [float(v) for v in values]
    except (TypeError, ValueError):
        raise ConfigurationError(f"{name} must be a list of numbers, got {values!r}") from None
    if len(vector) not in sizes or not np.isfinite(vector).all():
        raise ConfigurationError(
            f"{name} must be {' or '.join(map(str, sizes))} finite numbers, got {values!r}"
        )
    return vector


class _Round(ABC):
    """Discs and spheres of one radius; a disc seen from three dimensions is an upright cylinder."""

    radius: float

    @abstractmethod
    def centers(self, plant: Plant) -> Array:
        """Where they are now, shape (k, d), m."""

    def _velocities(self, plant: Plant) -> Array | float:
        return 0.0

    def nearest(self, point: Array, plant: Plant) -> Nearest:
        centers = self.centers(plant)
        d = centers.shape[1]
        refuse_more_dimensions(d, point.size)
        offset = point[:d] - centers
        length = np.sqrt(np.einsum("ij,ij->i", offset, offset))
        apart = np.where(length > 1e-12, length, 1.0)
        normal = np.zeros((len(centers), point.size))
        normal[:, :d] = offset / apart[:, None]
        normal[length <= 1e-12, 0] = 1.0  # at the very centre every way out is as good
        moving = np.zeros_like(normal)
        moving[:, :d] = self._velocities(plant)
        curvature = np.zeros_like(normal)
        curvature[:, :d] = 1.0 / np.maximum(length, 1e-9)[:, None]
        return Nearest(length - self.radius, normal, moving, curvature)

    def distances(self, points: Array, plant: Plant) -> Array:
        centers = self.centers(plant)
        d = centers.shape[1]
        refuse_more_dimensions(d, points.shape[1])
        offsets = points[:, None, :d] - centers
        return np.asarray(np.sqrt(np.einsum("kni,kni->kn", offsets, offsets)) - self.radius)


@dataclass
class Disc(_Round):
    """An upright cylinder: a disc of `radius` (m) in the plane at `center` (x, y). It stands still."""

    center: Sequence[float]
    radius: float

    def __post_init__(self) -> None:
        self.center = _vector("center", self.center, (2,))
        self.radius = positive("radius", self.radius, "m")

    def centers(self, plant: Plant) -> Array:
        return np.array([self.center])


@dataclass
class Sphere(_Round):
    """A ball of `radius` (m) at `center` (x, y, z). It stands still."""

    center: Sequence[float]
    radius: float

    def __post_init__(self) -> None:
        self.center = _vector("center", self.center, (3,))
        self.radius = positive("radius", self.radius, "m")

    def centers(self, plant: Plant) -> Array:
        return np.array([self.center])


@dataclass
class Plane:
    """A wall: everything behind `point` against the outward `normal` is forbidden; 1, 2 or 3 dimensions."""

    point: Sequence[float]
    normal: Sequence[float]

    def __post_init__(self) -> None:
        self.point = _vector("point", self.point, (1, 2, 3))
        self.normal = _vector("normal", self.normal, (len(self.point),))
        length = float(np.linalg.norm(self.normal))
        if length < 1e-12:
            raise ConfigurationError("normal must not be zero: it points from the wall into free space")
        self.normal = [n / length for n in self.normal]

    def nearest(self, point: Array, plant: Plant) -> Nearest:
        d = len(self.point)
        refuse_more_dimensions(d, point.size)
        normal = np.zeros((1, point.size))
        normal[0, :d] = self.normal
        distance = normal[0, :d] @ (point[:d] - np.asarray(self.point))
        return Nearest(np.array([distance]), normal, np.zeros_like(normal), np.zeros_like(normal))

    def distances(self, points: Array, plant: Plant) -> Array:
        offsets = points[:, : len(self.point)] - np.asarray(self.point)
        return np.asarray((offsets @ np.asarray(self.normal))[:, None])


@dataclass
class Box:
    """An axis-aligned block of `half_size` (m per axis) at `center`; 2 or 3 dimensions. It stands still."""

    center: Sequence[float]
    half_size: Sequence[float]

    def __post_init__(self) -> None:
        self.center = _vector("center", self.center, (2, 3))
        self.half_size = _vector("half_size", self.half_size, (len(self.center),))
        for half in self.half_size:
            positive("half_size", half, "m")

    def nearest(self, point: Array, plant: Plant) -> Nearest:
        """One surface: a face, an edge or a corner."""
        d = len(self.center)
        refuse_more_dimensions(d, point.size)
        offset = point[:d] - np.asarray(self.center)
        beyond = np.abs(offset) - np.asarray(self.half_size)
        side = np.where(offset < 0.0, -1.0, 1.0)
        outside = np.maximum(beyond, 0.0)
        distance = float(np.linalg.norm(outside))
        normal = np.zeros((1, point.size))
        curvature = np.zeros_like(normal)
        if distance > 0.0:
            normal[0, :d] = side * outside / distance
            if int((outside > 0.0).sum()) > 1:
                curvature[0, :d] = (outside > 0.0) / distance
        else:
            axis = int(np.argmax(beyond))
            distance = float(beyond[axis])
            normal[0, axis] = side[axis]
        return Nearest(np.array([distance]), normal, np.zeros_like(normal), curvature)

    def distances(self, points: Array, plant: Plant) -> Array:
        offsets = points[:, : len(self.center)] - np.asarray(self.center)
        beyond = np.abs(offsets) - np.asarray(self.half_size)
        outside = np.sqrt((np.maximum(beyond, 0.0) ** 2).sum(axis=1))
        return np.asarray((outside + np.minimum(beyond.max(axis=1), 0.0))[:, None])


@dataclass
class Discs(_Round):
    """Discs (or spheres) whose centres the env publishes, for example `hazard_positions`.

    Args:
        attribute: Name of the env's attribute, an array of shape (k, 2) or (k, 3) in m.
        radius: m; the robot's own radius is the constraint's business.
        velocity_attribute: Name of an array of the same shape in m/s; None says that they stand still.
    """

    attribute: str
    radius: float
    velocity_attribute: str | None = None

    def __post_init__(self) -> None:
        self.radius = positive("radius", self.radius, "m")

    def centers(self, plant: Plant) -> Array:
        where = np.asarray(plant.attribute(self.attribute), dtype=np.float64)
        if where.ndim != 2 or where.shape[1] not in (2, 3):
            raise ConfigurationError(
                f"the env's {self.attribute} must have shape (k, 2) or (k, 3), got {where.shape}"
            )
        return where

    def _velocities(self, plant: Plant) -> Array | float:
        if self.velocity_attribute is None:
            return 0.0
        return np.asarray(plant.attribute(self.velocity_attribute), dtype=np.float64)
