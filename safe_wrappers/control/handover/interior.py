"""What segments do between and at their ends: extrema inside a segment, steps of acceleration and torque at knots.

Source: appendix "Smooth Trajectories and Bumpless Transfer".
"""

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array
from safe_wrappers.control.handover.polynomials import Extrema, extrema
from safe_wrappers.control.handover.splines import (
    checked_samples,
    differentiate,
    hermite_at,
    positive_duration,
)
from safe_wrappers.errors import ConfigurationError


def interior_extrema(coefficients: ArrayLike, duration: ArrayLike, derivative: int) -> Extrema:
    """Smallest and largest position, velocity, acceleration or jerk over the whole segment, with their times.

    Not a search over samples: between the roots of the next derivative a polynomial is monotone.

    Args:
        coefficients: Shape (..., 6).
        duration: T in s, > 0, shape () or (...).
        derivative: 0 for position, 1 velocity, 2 acceleration, 3 jerk.

    Raises:
        ConfigurationError: For another derivative, or a duration that is not positive.
    """
    if derivative not in (0, 1, 2, 3):
        raise ConfigurationError(f"derivative is 0, 1, 2 or 3, got {derivative!r}")
    return extrema(differentiate(coefficients, derivative), positive_duration(duration))


def knot_acceleration_step(times: ArrayLike, positions: ArrayLike, velocities: ArrayLike) -> Array:
    """Jump of the acceleration of `hermite_series` at its inner knots, shape (..., k - 2); arguments as there."""
    knots, q, v = checked_samples(times, positions, velocities)
    span = np.diff(knots)
    ends = (q[..., :-1], v[..., :-1], q[..., 1:], v[..., 1:])
    before, after = hermite_at(ends, span, span, 2), hermite_at(ends, span, np.zeros_like(span), 2)
    return np.asarray(after[..., 1:] - before[..., :-1])


def knot_torque_step(
    inertia: ArrayLike, times: ArrayLike, positions: ArrayLike, velocities: ArrayLike
) -> Array:
    """Torque step M(q) dq'' at the inner knots of `hermite_series`, to be held against the torque-slew limit.

    Args:
        inertia: One number in kg m^2 for independent joints; or matrices M, shape (n, n), or (k - 2, n, n) for one
            per inner knot.
        times: Shape (k,), s.
        positions: Shape (..., k), and (..., n, k) with matrices.
        velocities: Shaped as the positions.

    Returns:
        Steps in N m, shaped as the positions but k - 2 long.

    Raises:
        ConfigurationError: As `hermite_series`, or for an inertia of another shape.
    """
    step = knot_acceleration_step(times, positions, velocities)
    m = np.asarray(inertia, dtype=np.float64)
    if m.ndim == 0:
        return np.asarray(m * step)
    joints = step.shape[-2] if step.ndim > 1 else 0
    if m.shape not in ((joints, joints), (step.shape[-1], joints, joints)):
        raise ConfigurationError(
            f"inertia is one number, or has shape (n, n) or (k - 2, n, n) with positions (..., n, k); "
            f"got {m.shape} with {joints} joints and {step.shape[-1]} inner knots"
        )
    by_knot = np.swapaxes(step, -1, -2)[..., None]
    return np.asarray(np.swapaxes((m @ by_knot)[..., 0], -1, -2))
