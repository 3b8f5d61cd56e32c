"""The bridge of a seam as a curve between the commands, and what it does between its ends.

Commands are held, so the curve is what a drive follows that interpolates them: the quintic itself. Polynomials, their
roots and splines are SciPy's.

Source: appendix "Smooth Trajectories and Bumpless Transfer".
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.control.handover.seams import backward_differences, stream_derivatives

if TYPE_CHECKING:
    from scipy.interpolate import PPoly


class Motion(NamedTuple):
    """Along a curve, in the order of time."""

    times: Array  # shape (k,), s
    position: Array  # shape (k, m), action units
    velocity: Array  # per s
    acceleration: Array  # per s^2


class BlendCurve(NamedTuple):
    """From the last command to where the new stream goes on bit for bit."""

    curve: PPoly  # of the time since the last command, s; values of shape (m,)
    control_dt: float

    @classmethod
    def of(cls, sent: Array, new: Array, steps: int, control_dt: float) -> BlendCurve:
        """The quintic of `seams.join` that bridges `steps` commands; its arguments."""
        from scipy.interpolate import BPoly, PPoly  # here: SciPy takes a while to import

        per_step = control_dt ** -np.arange(3.0)[:, None]
        before = np.stack(backward_differences(sent, 3)) * per_step
        after = np.stack([d[steps] for d in stream_derivatives(new)]) * per_step
        bridge = BPoly.from_derivatives([0.0, (steps + 1) * control_dt], [before, after])
        return cls(PPoly.from_bernstein_basis(bridge), control_dt)

    def peak(self, derivative: int) -> Array:
        """Largest magnitude of a derivative (0 to 3) by time over the whole curve, shape (m,).

        Not a search over samples: a polynomial is extreme at its ends or where its derivative is zero.
        """
        times = [np.concatenate([self.curve.x, inner]) for inner in self._extremes(derivative)]
        values = [self.curve(t, derivative)[:, j] for j, t in enumerate(times)]
        return np.array([np.abs(each).max() for each in values])

    def motion(self) -> Motion:
        """At every quarter of a control step, and where an acceleration is largest or smallest."""
        span = self.curve.x[-1]
        grid = np.linspace(0.0, span, 4 * round(span / self.control_dt) + 1)
        times = np.unique(np.concatenate([grid, *self._extremes(2)]))
        return Motion(times, *(self.curve(times, order) for order in range(3)))

    def _extremes(self, derivative: int) -> list[Array]:
        """For each component the times at which a derivative may be extreme between the ends."""
        found = self.curve.derivative(derivative + 1).roots(discontinuity=False, extrapolate=False)
        return [times[np.isfinite(times)] for times in found]


def knot_torque_step(inertia: Array, spacing: float, positions: Array) -> Array:
    """Torque steps M(q) dq'' at the inner knots of the cubic Hermite spline through positions, N m, shape (k - 2, m).

    They are to be held against the torque-slew limit.

    Args:
        inertia: Matrices M, one per inner knot, shape (k - 2, m, m), kg m^2.
        spacing: From one knot to the next, s.
        positions: Shape (k, m), rad; rates at the knots are central differences.
    """
    bend = hermite_spline(positions, spacing).derivative(2)
    at_starts, at_ends = bend.c[-1], np.polyval(bend.c, spacing)
    jumps = at_starts[1:] - at_ends[:-1]
    return np.asarray((inertia @ jumps[:, :, None])[:, :, 0])


def hermite_spline(positions: Array, spacing: float) -> PPoly:
    """The cubic Hermite spline through positions (k, m), `spacing` apart, with central differences as rates."""
    from scipy.interpolate import CubicHermiteSpline

    rates = np.gradient(positions, spacing, axis=0)
    return CubicHermiteSpline(spacing * np.arange(len(positions)), positions, rates)
