"""TrackedDiscs: obstacles whose positions are estimates, as much larger as the estimates are uncertain."""

from dataclasses import dataclass

import numpy as np

from safe_wrappers.checks import non_negative, positive
from safe_wrappers.constraints.obstacles.obstacles import Nearest, refuse_more_dimensions
from safe_wrappers.control.estimation.ellipsoids import ellipsoid_gap
from safe_wrappers.control.estimation.tracks import Tracks
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.constraint import Array
from safe_wrappers.plants.plant import Plant

_SHARES = (1e-4, 0.1, 0.25, 0.5, 1.0)
"""Of the horizon, at which the growth is looked at; the first of them for its rate now."""


@dataclass
class TrackedDiscs:
    """Discs (or balls) that an `OcclusionPenalty` inside the filter tracks.

    Each is the ellipsoid of `sigmas` standard deviations about its estimate. The surface moves with the estimated
    velocity, and grows: its speed towards the machine is the fastest at which the bound comes nearer within
    `horizon_s` without further measurements. `Workspace` uses the distances alone, without growth.

    A centre leaves its ellipsoid with the probability of the tail of `sigmas` (for Gaussian noise, a true motion
    model and 3: 0.27 % of the time on a line, 1.1 % in the plane), each obstacle at each moment. It is no hard bound.

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
            raise ConfigurationError(
                f"the env's {self.attribute} holds no tracks but {type(tracks).__name__}; TrackedDiscs need an "
                "OcclusionPenalty inside the filter"
            )
        return tracks

    def nearest(self, point: Array, plant: Plant) -> Nearest:
        """One surface per track."""
        tracks = self.tracks(plant)
        d, n = tracks.coordinates, len(tracks.mean)
        refuse_more_dimensions(d, point.size, "tracks")
        normal, velocity = np.zeros((n, point.size)), np.zeros((n, point.size))
        nothing = np.zeros((n, point.size))
        offset = point[:d] - tracks.positions
        covariances = tracks.position_covariances
        if not (np.isfinite(offset).all() and np.isfinite(covariances).all()):
            return Nearest(np.full(n, np.nan), normal, velocity, nothing)
        distance, normal[:, :d] = ellipsoid_gap(offset, self.sigmas**2 * covariances)
        velocity[:, :d] = self._velocity(tracks, normal[:, :d])
        return Nearest(distance - self.radius, normal, velocity, nothing)

    def _velocity(self, tracks: Tracks, normal: Array) -> Array:
        """The estimated velocity, and along the normal the fastest rate at which the bound moves outwards."""
        times = np.array([share * self.horizon_s for share in _SHARES])
        positions, covariances = tracks.ahead(times.tolist())
        along = ((positions - tracks.positions) * normal).sum(axis=-1)
        grown = _deviation(covariances, normal) - _deviation(tracks.position_covariances, normal)
        fastest = ((along + self.sigmas * grown) / times[:, None]).max(axis=0)
        own = tracks.velocities
        return np.asarray(own + (fastest - (own * normal).sum(axis=-1))[:, None] * normal)

    def boxes(self, plant: Plant, times_s: Array) -> tuple[Array, Array]:
        """Boxes along the axes that hold the centres' bounds some times ahead, if nothing is seen until then.

        Returns:
            Centres and half-widths, shapes (k, n, d), m.
        """
        positions, covariances = self.tracks(plant).ahead(times_s.tolist())
        variances = np.diagonal(covariances, axis1=-2, axis2=-1)
        return positions, self.sigmas * np.sqrt(np.maximum(variances, 0.0))

    def distances(self, points: Array, plant: Plant) -> Array:
        """Shape (k, n), m, at the present bound."""
        tracks = self.tracks(plant)
        d, n = tracks.coordinates, len(tracks.mean)
        offsets = points[:, None, :d] - tracks.positions
        shapes = np.broadcast_to(
            self.sigmas**2 * tracks.position_covariances, (len(points), n, d, d)
        ).reshape(-1, d, d)
        flat = offsets.reshape(-1, d)
        if not (np.isfinite(flat).all() and np.isfinite(shapes).all()):
            return np.full((len(points), n), np.nan)
        return ellipsoid_gap(flat, shapes)[0].reshape(len(points), n) - self.radius


def _deviation(covariances: Array, normal: Array) -> Array:
    """Standard deviations along the normals, shape (..., n)."""
    variance = (normal * (covariances @ normal[:, :, None])[..., 0]).sum(axis=-1)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))
