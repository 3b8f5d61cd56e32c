"""Tracks of things whose velocity turns: the extended Kalman filter on coordinated turns."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array
from safe_wrappers.control.estimation.lie_derivatives import nonlinear_observability
from safe_wrappers.control.estimation.tracks import Motion, Tracks, largest_deviation
from safe_wrappers.control.estimation.turning import SIZE, Turns, flow, gathered_noise, rates
from safe_wrappers.errors import ConfigurationError

_SHORTEST_S: Final = 1e-3
"""Times up to this are taken in one go, however fast the turn: an estimate that ran away still ends."""


class TurningTracks(Tracks):
    """Means and covariances of n tracks in the plane, of which at least one turns.

    A state is (position, velocity, turn rate). Between measurements the mean goes where the motion leads it without
    noise, and the covariance follows the Lyapunov equation of the motion linearised along that way. So it is exact
    where no track turns (those have the turn rate 0, and it is known), and of first order in the turns.

    Args:
        motions: One per track, of two coordinates each.

    Attributes:
        size: Of a state: 5.
        mean: Positions, velocities and turn rates, shape (n, 5), m, m/s and rad/s.
        covariance: Shape (n, 5, 5).

    Raises:
        ConfigurationError: Motions that are not of two coordinates.
    """

    def __init__(self, motions: Sequence[Motion]) -> None:
        super().__init__(motions)
        if self.coordinates != 2:
            raise ConfigurationError(
                f"things turn in the plane: tracks of 2 coordinates, not {self.coordinates}"
            )
        self.size = SIZE
        self.mean = np.zeros((len(self.motions), SIZE))
        self.covariance = np.zeros((len(self.motions), SIZE, SIZE))
        self.turns = Turns(
            np.stack([motion.intensity for motion in self.motions]),
            np.array([motion.turn_noise or 0.0 for motion in self.motions]),
            np.array([1.0 / motion.reversion_s for motion in self.motions]),
            np.stack([motion.mean_velocity for motion in self.motions]),
        )

    def advance(self, time_s: float) -> None:
        """Predict over a time without measurements."""
        longest, left = self._longest_s(), float(time_s)
        while left > 0.0:
            (self.mean,), (self.covariance,) = self._after(self.mean, self.covariance, [min(left, longest)])
            left -= longest

    def see(self, which: NDArray[np.intp], measured: Array, matrix: Array, noise: Array) -> None:
        """As `Tracks.see`; `matrix` is of positions and velocities, shape (m, 4): no turn rate is measured."""
        super().see(which, measured, np.pad(matrix, ((0, 0), (0, 1))), noise)

    def ahead(self, times_s: Sequence[float]) -> tuple[Array, Array]:
        """As `Tracks.ahead`."""
        times, longest = np.asarray(times_s, dtype=np.float64), self._longest_s()
        means = np.full((times.size, *self.mean.shape), np.nan)
        covariances = np.full((times.size, *self.covariance.shape), np.nan)
        mean, covariance, begun = self.mean, self.covariance, 0.0
        while True:
            here = (times >= begun) & (times <= begun + longest)
            means[here], covariances[here] = self._after(mean, covariance, times[here] - begun)
            if not times.max(initial=0.0) > begun + longest:
                return means[..., :2], covariances[..., :2, :2]
            (mean,), (covariance,) = self._after(mean, covariance, [longest])
            begun += longest

    def blind_times(self, deviation: float, horizon_s: float, step_s: float) -> Array:
        """How long no position's deviation exceeds this one (m) if nothing is measured, s, (n,), in whole steps.

        0 if it does now or at the first step; inf if it does not within the horizon.
        """
        times = step_s * np.arange(1, int(np.ceil(horizon_s / step_s)) + 1)
        now = largest_deviation(self.position_covariances)
        beyond = np.concatenate([now[None], largest_deviation(self.ahead(times.tolist())[1])]) > deviation
        last = np.maximum(beyond.argmax(axis=0) - 1, 0) * step_s
        return np.where(beyond.any(axis=0), last, np.inf)

    def unobservable(self, track: int, matrix: Array, names: Sequence[str]) -> tuple[str, ...]:
        """What measurements (m, 4) of a track's position and velocity do not tell at its present estimate.

        Args:
            track: Which.
            matrix: C.
            names: Of position and velocity.
        """
        found = nonlinear_observability(
            lambda state: rates(self.turns, track, state),
            lambda state: matrix @ state[:4],
            self.mean[track],
            names=[*names, "turn rate"],
        )
        return found.names

    def _longest_s(self) -> float:
        return max(self.turns.longest_s(self.mean), _SHORTEST_S)

    def _after(self, mean: Array, covariance: Array, times_s: Sequence[float] | Array) -> tuple[Array, Array]:
        """Means (k, n, 5) and covariances (k, n, 5, 5) at k times."""
        times = np.asarray(times_s, dtype=np.float64)
        there = flow(self.turns, np.broadcast_to(mean, (times.size, *mean.shape)), times)
        grown = there.jacobian @ covariance @ there.jacobian.swapaxes(-1, -2)
        grown += gathered_noise(self.turns, mean, times)
        return there.state, 0.5 * (grown + grown.swapaxes(-1, -2))


def tracks_of(motions: Sequence[Motion]) -> Tracks:
    """Tracks of these motions: linear ones, unless one of them turns."""
    turns = any(motion.turn_noise is not None for motion in motions)
    return TurningTracks(motions) if turns else Tracks(motions)
