"""Things to keep clear of, as plain data, so that a wrapper that is given them can be recorded and rebuilt."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np

from safe_wrappers.control.backup.stopping import Nearest
from safe_wrappers.control.estimation import Tracks
from safe_wrappers.errors import (
    Array,
    ConfigurationError,
    finite_array,
    non_negative,
    of_kind,
    positive,
)
from safe_wrappers.plants.plant import Plant

_AT_THE_CENTRE = 1e-12  # m; closer to the centre of a round one every way out is as good
_SHARES = (1e-4, 0.1, 0.25, 0.5, 1.0)  # of the horizon, at which growth is looked at; the first: its rate now


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


def _seen(obstacle: int, points: Array, kind: str = "obstacles") -> Array:
    """Those coordinates of points (..., d) that an obstacle has; along the others it reaches without end."""
    if obstacle > points.shape[-1]:
        raise ConfigurationError(
            f"{obstacle}-dimensional {kind} cannot meet a {points.shape[-1]}-dimensional point"
        )
    return points[..., :obstacle]


def _spread(parts: Array, d: int) -> Array:
    """Of vectors (k, n) those with zeros along the other coordinates, shape (k, d)."""
    spread = np.zeros((len(parts), d))  # np.pad takes a hundred times as long
    spread[:, : parts.shape[1]] = parts
    return spread


def _vector(name: str, values: Sequence[float], sizes: tuple[int, ...]) -> list[float]:
    vector = finite_array(name, values)
    if vector.ndim != 1 or vector.size not in sizes:
        raise ConfigurationError(
            f"{name} must be {' or '.join(map(str, sizes))} finite numbers, got {values!r}"
        )
    found: list[float] = vector.tolist()
    return found


class Round(ABC):
    """Discs and spheres of one radius; a disc seen from three dimensions is an upright cylinder."""

    radius: float

    @abstractmethod
    def centers(self, plant: Plant) -> Array:
        """Where they are now, shape (k, d), m."""

    def _velocities(self, plant: Plant) -> Array | None:
        """Of the centres, m/s, shape (k, d), or None: they stand still."""
        return None

    def distances(self, points: Array, plant: Plant) -> Array:
        """Signed distances of points of shape (k, d), shape (k, surfaces), m."""
        centers = self.centers(plant)
        away = _seen(centers.shape[1], points)[:, None] - centers
        return np.asarray(np.sqrt((away * away).sum(axis=2)) - self.radius)

    def nearest(self, point: Array, plant: Plant) -> Nearest:
        """What is nearest of every surface; at a centre every way out is as good."""
        centers, velocities = self.centers(plant), self._velocities(plant)
        away = _seen(centers.shape[1], point) - centers
        length = np.sqrt((away * away).sum(axis=1))[:, None]
        away = np.where(length > _AT_THE_CENTRE, away, np.eye(1, centers.shape[1]))
        normal = away / np.where(length > _AT_THE_CENTRE, length, 1.0)
        curvature = np.broadcast_to(1.0 / np.maximum(length, 1e-9), away.shape)
        moving = np.zeros_like(away) if velocities is None else velocities
        return Nearest(
            length[:, 0] - self.radius, *(_spread(part, point.size) for part in (normal, moving, curvature))
        )


@dataclass
class _Still(Round):
    """One that stands still."""

    center: Sequence[float]
    radius: float
    coordinates: ClassVar[int]

    def __post_init__(self) -> None:
        self.center = _vector("center", self.center, (self.coordinates,))
        self.radius = positive("radius", self.radius, "m")

    def centers(self, plant: Plant) -> Array:
        return np.array([self.center])


class Disc(_Still):
    """An upright cylinder: a disc of `radius` (m) in the plane at `center` (x, y). It stands still."""

    coordinates = 2


class Sphere(_Still):
    """A ball of `radius` (m) at `center` (x, y, z). It stands still."""

    coordinates = 3


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

    def distances(self, points: Array, plant: Plant) -> Array:
        """Signed distances of points of shape (k, d), shape (k, 1), m."""
        offset = _seen(len(self.point), points) - self.point
        return np.asarray((offset * self.normal).sum(axis=1, keepdims=True))

    def nearest(self, point: Array, plant: Plant) -> Nearest:
        """The wall."""
        still = np.zeros((1, point.size))
        normal = _spread(np.array([self.normal]), point.size)
        return Nearest(self.distances(point[None], plant)[0], normal, still, still)


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

    def distances(self, points: Array, plant: Plant) -> Array:
        """Signed distances of points of shape (k, d), shape (k, 1), m."""
        offset = _seen(len(self.center), points) - self.center
        return _from_block(offset, np.array(self.half_size))[0][:, None]

    def nearest(self, point: Array, plant: Plant) -> Nearest:
        """The nearest face, edge or corner."""
        offset = _seen(len(self.center), point) - self.center
        distance, normal = _from_block(offset[None], np.array(self.half_size))
        sides = normal != 0.0
        # About edges and corners the surfaces of equal distance are round.
        round_ = sides & (sides.sum(axis=1, keepdims=True) > 1)
        curvature = np.where(round_, 1.0 / np.where(round_, distance[:, None], 1.0), 0.0)
        normal, curvature = (_spread(part, point.size) for part in (normal, curvature))
        return Nearest(distance, normal, np.zeros_like(normal), curvature)


def _from_block(offset: Array, half: Array) -> tuple[Array, Array]:
    """Signed distances, shape (k,), and normals, shape (k, n), of offsets (k, n) from blocks' centres."""
    beyond = np.abs(offset) - half
    outside, towards = np.maximum(beyond, 0.0), np.where(offset < 0.0, -1.0, 1.0)
    length, deepest = np.sqrt((outside * outside).sum(axis=1)), beyond.max(axis=1)
    face = np.eye(offset.shape[1])[beyond.argmax(axis=1)]
    inside = ~(length > 0.0)
    normal = np.where(inside[:, None], face, outside / np.where(inside, 1.0, length)[:, None])
    return np.where(inside, deepest, length), normal * towards


@dataclass
class Discs(Round):
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
            wanted = f"the env's {self.attribute} must have shape (k, 2) or (k, 3)"
            raise ConfigurationError(f"{wanted}, got {where.shape}")
        return where

    def _velocities(self, plant: Plant) -> Array | None:
        if self.velocity_attribute is None:
            return None
        return np.asarray(plant.attribute(self.velocity_attribute), dtype=np.float64)


@dataclass
class TrackedDiscs:
    """Discs (or balls) that an `OcclusionPenalty` inside the filter tracks.

    Each is the box of `sigmas` standard deviations along every coordinate about its estimate, and `radius` around it.
    It moves with the estimated velocity and grows as it would within `horizon_s` without further measurements (not
    for `Workspace`). The bound is not hard: at each moment the centre is outside with the probability of the tail of
    `sigmas`.

    Args:
        radius: m; the machine's own radius is the constraint's business.
        sigmas: Standard deviations, at least 0; 0 takes the estimate for the truth.
        horizon_s: How far ahead the growth counts, s: at least the time that the machine takes to brake.
        attribute: Name of the env's attribute that has the tracks.

    Source: appendix "Continuous Lyapunov and Riccati covariance dynamics".
    """

    radius: float
    sigmas: float = 3.0
    horizon_s: float = 1.0
    attribute: str = "tracking"

    def __post_init__(self) -> None:
        self.radius = positive("radius", self.radius, "m")
        self.sigmas = non_negative("sigmas", self.sigmas, "standard deviations")
        self.horizon_s = positive("horizon_s", self.horizon_s, "s")

    def tracks(self, plant: Plant) -> Tracks:
        """The tracks that the env holds, or an error that says what is missing."""
        tracks = plant.attribute(self.attribute)
        if not isinstance(tracks, Tracks):
            found = f"the env's {self.attribute} holds no tracks but {type(tracks).__name__}"
            raise ConfigurationError(f"{found}; TrackedDiscs need an OcclusionPenalty inside the filter")
        return tracks

    def nearest(self, point: Array, plant: Plant) -> Nearest:
        times = self.horizon_s * np.array(_SHARES)
        centers, halves = self.boxes(plant, np.concatenate([[0.0], times]))
        d = centers.shape[2]
        distance, facing = _from_block(_seen(d, point, "tracks") - centers[0], halves[0])
        normal = _spread(facing, point.size)
        # The estimated velocity, and along the normal the fastest rate at which the box moves outwards.
        out, own = facing, self.tracks(plant).velocities
        reach = (centers * out + halves * np.abs(out)).sum(axis=-1)
        fastest = ((reach[1:] - reach[0]) / times[:, None]).max(axis=0)
        velocity = _spread(own + (fastest - (own * out).sum(axis=-1))[:, None] * out, point.size)
        return Nearest(distance - self.radius, normal, velocity, np.zeros_like(normal))

    def boxes(self, plant: Plant, times_s: Array) -> tuple[Array, Array]:
        """Centres and half-widths, (k, n, d), m, of boxes that hold the bounds at times ahead, if nothing is seen."""
        positions, covariances = self.tracks(plant).ahead(times_s.tolist())
        variances = np.diagonal(covariances, axis1=-2, axis2=-1)
        return positions, self.sigmas * np.sqrt(np.maximum(variances, 0.0))


KINDS: dict[str, type[Any]] = {k.__name__: k for k in (Disc, Sphere, Plane, Box, Discs, TrackedDiscs)}


def obstacles_from(
    given: Any, name: str = "obstacles", kinds: tuple[type[Any], ...] = (), optional: bool = False
) -> list[Any]:
    """A list of obstacles, each itself or as its dict, of these kinds (none: all); it may be empty if `optional`."""
    fitting = " and ".join(kind.__name__ for kind in kinds) or "obstacles"
    if isinstance(given, dict | str) or not isinstance(given, Sequence) or not (given or optional):
        wanted = f"list of {fitting}" if optional else "list with at least one obstacle"
        raise ConfigurationError(f"{name} is a {wanted}, got {given!r}")
    found = [o if hasattr(o, "nearest") else of_kind(KINDS, o, "an obstacle") for o in given]
    for obstacle in found:
        if kinds and not isinstance(obstacle, kinds):
            raise ConfigurationError(f"{name} holds {fitting}, got {type(obstacle).__name__}")
    return found
