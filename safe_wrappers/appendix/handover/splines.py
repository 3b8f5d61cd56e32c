"""Quintic and cubic segments: values, linear systems, the largest torque under a bound of the inertia.

Source: appendix "Smooth Trajectories and Bumpless Transfer".
"""

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, finite_arrays
from safe_wrappers.control.handover.interior import interior_extrema
from safe_wrappers.control.handover.splines import differentiate, hermite_at, positive_duration, value
from safe_wrappers.errors import ConfigurationError


def evaluate(coefficients: ArrayLike, t: ArrayLike, derivative: int = 0) -> Array:
    """A segment, or its derivative of any order, at times t in s from its start.

    Times outside [0, T] are not clamped.

    Args:
        coefficients: Shape (..., n), lowest power first.
        t: Times common to the batch, shape () or (k,).
        derivative: 0 for position, 1 velocity, 2 acceleration, 3 jerk.

    Returns:
        Shape (...) for one time, (..., k) for k.

    Raises:
        ConfigurationError: For a derivative that is not an integer >= 0.
    """
    if not isinstance(derivative, int | np.integer) or derivative < 0:
        raise ConfigurationError(f"derivative is an integer >= 0, got {derivative!r}")
    at = np.asarray(t, dtype=np.float64)
    c = differentiate(coefficients, int(derivative))
    return value(c.reshape((*c.shape[:-1], *[1] * at.ndim, c.shape[-1])), at)


def hermite(
    q0: ArrayLike,
    v0: ArrayLike,
    q1: ArrayLike,
    v1: ArrayLike,
    duration: ArrayLike,
    t: ArrayLike,
    derivative: int = 0,
) -> Array:
    """The cubic through two positions with two velocities, at times t in s from its start, not clamped.

    Args:
        q0: Position at t = 0, shape (...).
        v0: Velocity at t = 0.
        q1: Position at t = duration.
        v1: Velocity at t = duration.
        duration: T in s, > 0.
        t: Times common to the batch, shape () or (k,).
        derivative: By time: 0 for position, 1 velocity, 2 acceleration, 3 jerk.

    Returns:
        Shape (...) for one time, (..., k) for k.

    Raises:
        ConfigurationError: For a duration that is not positive, values that are not finite, shapes that do not
            broadcast, or another derivative.
    """
    span, q0, v0, q1, v1 = finite_arrays(duration=positive_duration(duration), q0=q0, v0=v0, q1=q1, v1=v1)
    at = np.asarray(t, dtype=np.float64)
    q0, v0, q1, v1, span = (x.reshape((*x.shape, *[1] * at.ndim)) for x in (q0, v0, q1, v1, span))
    return hermite_at((q0, v0, q1, v1), span, at, derivative)


def quintic_system(duration: ArrayLike) -> Array:
    """The confluent Vandermonde matrix M, shape (..., 6, 6), of `M a = (q0, q0', q0'', q1, q1', q1'')`."""
    span = positive_duration(duration)
    matrix = np.zeros((*span.shape, 6, 6))
    for order, row in enumerate(np.eye(6)[:3] * [1.0, 1.0, 2.0, 0.0, 0.0, 0.0]):
        matrix[..., order, :] = row
        factors = np.array([np.prod(np.arange(power, power - order, -1.0)) for power in range(6)])
        for power in range(order, 6):
            matrix[..., 3 + order, power] = factors[power] * span ** (power - order)
    return matrix


def quintic_reduced_system(duration: ArrayLike) -> tuple[Array, Array]:
    """The matrix, shape (..., 3, 3), of the three highest coefficients, and its analytic inverse.

    `matrix @ (a3, a4, a5)` is what the end state lacks after the start state's parabola: `(q1 - q0 - q0' T -
    q0'' T^2 / 2, q1' - q0' - q0'' T, q1'' - q0'')`. Its determinant is 2 T^9, so T > 0 has one solution.
    """
    t = positive_duration(duration)
    matrix = quintic_system(t)[..., 3:, 3:]
    rows = [
        [10.0 / t**3, -4.0 / t**2, 0.5 / t],
        [-15.0 / t**4, 7.0 / t**3, -1.0 / t**2],
        [6.0 / t**5, -3.0 / t**4, 0.5 / t**3],
    ]
    return matrix, np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def jerk_profile(coefficients: ArrayLike) -> Array:
    """The jerk of quintics as a quadratic in t: `(6 a3, 24 a4, 60 a5)`, shape (..., 3), lowest power first."""
    return differentiate(coefficients, 3)


def peak_torque(coefficients: ArrayLike, duration: ArrayLike, inertia: ArrayLike) -> Array:
    """Largest inertial torque over the segment, given an upper bound of the inertia, shape (...).

    The bound times the largest |acceleration|: gravity, friction, Coriolis terms and the coupling of joints come
    on top of it, and so does the response of an elastic joint.

    Args:
        coefficients: Shape (..., 6), rad.
        duration: T in s, > 0.
        inertia: Upper bound along the segment, kg m^2, > 0, shape () or (...).

    Raises:
        ConfigurationError: For an inertia or a duration that is not positive.
    """
    bound = np.asarray(inertia, dtype=np.float64)
    if not (np.isfinite(bound).all() and (bound > 0.0).all()):
        raise ConfigurationError(f"inertia is an upper bound in kg m^2, > 0 and finite; got {bound}")
    return np.asarray(bound * interior_extrema(coefficients, duration, 2).peak)
