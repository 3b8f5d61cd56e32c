"""Things to keep clear of, as plain data, so that a wrapper that is given them can be recorded and rebuilt."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np

from safe_wrappers.control.estimation import Tracks
from safe_wrappers.control.numerics.shapes import (
    BLOCK,
    PLANE,
    ROUND,
    SURFACE_NUMBERS,
    nearest_points,
    surface_distances,
)
from safe_wrappers.errors import (
    Array,
    ConfigurationError,
    finite_array,
    non_negative,
    positive,
    settings_from,
)
from safe_wrappers.plants.plant import Plant

_SHARES = (1e-4, 0.1, 0.25, 0.5, 1.0)  # of the horizon, at which growth is looked at; the first: its rate now


class Nearest(NamedTuple):
    """For one point and k surfaces in d dimensions."""

    distance: Array  # signed, m, negative inside, shape (k,)
    normal: Array  # unit vectors from the surface towards the point, shape (k, d)
    velocity: Array  # of the surface, m/s, shape (k, d)
    curvature: Array  # of the surface of equal distance through the point, along each coordinate, 1/m, (k, d)


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
    vector = finite_array(name, values)
    if vector.ndim != 1 or vector.size not in sizes:
        raise ConfigurationError(
            f"{name} must be {' or '.join(map(str, sizes))} finite numbers, got {values!r}"
        )
    found: list[float] = vector.tolist()
    return found


class Plain(ABC):
    """Planes, balls, cylinders and blocks: `control/numerics/shapes.py` knows what is nearest."""

    still: ClassVar[bool] = True
    """Whether `surfaces` is always the same, and nothing moves."""

    @abstractmethod
    def surfaces(self, plant: Plant) -> Array:
        """As in `control/numerics/shapes.py`, shape (k, 8)."""

    def _velocities(self, plant: Plant) -> Array | None:
        """Of the surfaces, m/s, shape (k, coordinates), or None: they stand still."""
        return None

    def _seen_from(self, coordinates: int, plant: Plant) -> Array:
        surfaces = self.surfaces(plant)
        if len(surfaces):
            refuse_more_dimensions(int(surfaces[0, 1]), coordinates)
        return surfaces

    def distances(self, points: Array, plant: Plant) -> Array:
        """Signed distances of points of shape (k, d), shape (k, surfaces), m."""
        return surface_distances(self._seen_from(points.shape[1], plant), points)

    def nearest(self, point: Array, plant: Plant) -> Nearest:
        """What is nearest of every surface."""
        surfaces = self._seen_from(point.size, plant)
        distance, normal, curvature = nearest_points(surfaces, point)
        velocities, moving = self._velocities(plant), np.zeros_like(normal)
        if velocities is not None:
            moving[:, : velocities.shape[1]] = velocities
        return Nearest(distance, normal, moving, curvature)


def _surface(kind: float, first: Sequence[float], second: Sequence[float]) -> Array:
    """One surface, shape (1, 8)."""
    row = np.zeros((1, SURFACE_NUMBERS))
    row[0, :2] = kind, len(first)
    row[0, 2 : 2 + len(first)], row[0, 5 : 5 + len(second)] = first, second
    return row


class _Round(Plain):
    """Discs and spheres of one radius; a disc seen from three dimensions is an upright cylinder."""

    radius: float

    @abstractmethod
    def centers(self, plant: Plant) -> Array:
        """Where they are now, shape (k, d), m."""

    def surfaces(self, plant: Plant) -> Array:
        centers = self.centers(plant)
        found = np.zeros((len(centers), SURFACE_NUMBERS))
        found[:, 0], found[:, 1], found[:, 5] = ROUND, centers.shape[1], self.radius
        found[:, 2 : 2 + centers.shape[1]] = centers
        return found


@dataclass
class _Still(_Round):
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
class Plane(Plain):
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

    def surfaces(self, plant: Plant) -> Array:
        return _surface(PLANE, self.point, self.normal)


@dataclass
class Box(Plain):
    """An axis-aligned block of `half_size` (m per axis) at `center`; 2 or 3 dimensions. It stands still."""

    center: Sequence[float]
    half_size: Sequence[float]

    def __post_init__(self) -> None:
        self.center = _vector("center", self.center, (2, 3))
        self.half_size = _vector("half_size", self.half_size, (len(self.center),))
        for half in self.half_size:
            positive("half_size", half, "m")

    def surfaces(self, plant: Plant) -> Array:
        return _surface(BLOCK, self.center, self.half_size)


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

    still = False

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
        n, d = centers.shape[1:]
        refuse_more_dimensions(d, point.size, "tracks")
        blocks = np.zeros((n, SURFACE_NUMBERS))
        blocks[:, 0], blocks[:, 1], blocks[:, 2 : 2 + d], blocks[:, 5 : 5 + d] = (
            BLOCK,
            d,
            centers[0],
            halves[0],
        )
        distance, normal, _ = nearest_points(blocks, point)
        # The estimated velocity, and along the normal the fastest rate at which the box moves outwards.
        out, own = normal[:, :d], self.tracks(plant).velocities
        reach = (centers * out + halves * np.abs(out)).sum(axis=-1)
        fastest = ((reach[1:] - reach[0]) / times[:, None]).max(axis=0)
        velocity = np.zeros_like(normal)
        velocity[:, :d] = own + (fastest - (own * out).sum(axis=-1))[:, None] * out
        return Nearest(distance - self.radius, normal, velocity, np.zeros_like(normal))

    def boxes(self, plant: Plant, times_s: Array) -> tuple[Array, Array]:
        """Centres and half-widths, (k, n, d), m, of boxes that hold the bounds at times ahead, if nothing is seen."""
        positions, covariances = self.tracks(plant).ahead(times_s.tolist())
        variances = np.diagonal(covariances, axis1=-2, axis2=-1)
        return positions, self.sigmas * np.sqrt(np.maximum(variances, 0.0))


KINDS: dict[str, type[Any]] = {k.__name__: k for k in (Disc, Sphere, Plane, Box, Discs, TrackedDiscs)}


def obstacle_from(data: Any) -> Obstacle:
    """An obstacle itself, or rebuilt from the plain dict that a recorded wrapper holds."""
    if not isinstance(data, dict):
        if hasattr(data, "nearest"):
            return data  # type: ignore[no-any-return]
        raise ConfigurationError(f"expected an obstacle ({', '.join(KINDS)}) or its dict, got {data!r}")
    name = data.get("kind")
    if name not in KINDS:
        raise ConfigurationError(f"unknown obstacle kind {name!r}; the kinds are {', '.join(KINDS)}")
    obstacle: Obstacle = settings_from(KINDS[name], {k: v for k, v in data.items() if k != "kind"}, name)
    return obstacle


def obstacles_from(
    given: Any, name: str = "obstacles", kinds: tuple[type[Any], ...] = (), optional: bool = False
) -> list[Any]:
    """A list of obstacles, each itself or as its dict, of these kinds (none: all); it may be empty if `optional`."""
    fitting = " and ".join(kind.__name__ for kind in kinds) or "obstacles"
    if isinstance(given, dict | str) or not isinstance(given, Sequence) or not (given or optional):
        wanted = f"list of {fitting}" if optional else "list with at least one obstacle"
        raise ConfigurationError(f"{name} is a {wanted}, got {given!r}")
    found = [obstacle_from(o) for o in given]
    for obstacle in found:
        if kinds and not isinstance(obstacle, kinds):
            raise ConfigurationError(f"{name} holds {fitting}, got {type(obstacle).__name__}")
    return found
