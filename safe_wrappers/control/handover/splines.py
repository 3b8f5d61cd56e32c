"""Quintic and cubic Hermite segments: closed forms, and what happens between their ends.

Boundary values have any shape (...) that broadcasts; the duration is in s, > 0, and broadcasts with them. Times
of evaluation are common to the whole batch, and their axes come last: times of shape (k,) give (..., k), one time
gives (...). Positions in any unit q, velocities in q/s, and so on.

A quintic matches position, velocity and acceleration at both ends, so a join of two has no acceleration step. The
ends say nothing of the interior: check `interior_extrema` and `peak_torque` against the machine's limits. A cubic
Hermite spline is once continuously differentiable only: the torque steps at every knot (`knot_torque_step`).

Source: appendix "Smooth Trajectories and Bumpless Transfer".
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.control.numerics.finite import finite_arrays
from safe_wrappers.control.numerics.polynomials import Extrema, differentiate, extrema, value
from safe_wrappers.errors import ConfigurationError

Array = NDArray[np.float64]


def _positive_duration(duration: ArrayLike) -> Array:
    try:
        span = np.asarray(duration, dtype=np.float64)
    except (TypeError, ValueError):
        raise ConfigurationError(f"duration is a time in seconds, got {duration!r}") from None
    if not (np.isfinite(span).all() and (span > 0.0).all()):
        raise ConfigurationError(f"duration is a time in seconds, > 0 and finite; got {span}")
    return span


def _boundary(duration: ArrayLike, **values: ArrayLike) -> tuple[Array, list[Array]]:
    span, *arrays = finite_arrays(duration=_positive_duration(duration), **values)
    return span, arrays


def quintic_coefficients(
    q0: ArrayLike,
    v0: ArrayLike,
    a0: ArrayLike,
    q1: ArrayLike,
    v1: ArrayLike,
    a1: ArrayLike,
    duration: ArrayLike,
) -> Array:
    """Coefficients (..., 6), lowest power of t first, of the quintic through two states of q, q', q''.

    Args:
        q0: Position at t = 0, shape (...).
        v0: Velocity at t = 0.
        a0: Acceleration at t = 0.
        q1: Position at t = duration.
        v1: Velocity at t = duration.
        a1: Acceleration at t = duration.
        duration: T in s, > 0.

    Raises:
        ConfigurationError: For a duration that is not positive, values that are not finite, or shapes that do
            not broadcast.
    """
    span, (q0, v0, a0, q1, v1, a1) = _boundary(duration, q0=q0, v0=v0, a0=a0, q1=q1, v1=v1, a1=a1)
    way, half = q1 - q0, 0.5 * span**2
    c3 = (10.0 * way - (6.0 * v0 + 4.0 * v1) * span - (3.0 * a0 - a1) * half) / span**3
    c4 = (-15.0 * way + (8.0 * v0 + 7.0 * v1) * span + (3.0 * a0 - 2.0 * a1) * half) / span**4
    c5 = (6.0 * way - 3.0 * (v0 + v1) * span - (a0 - a1) * half) / span**5
    return np.stack([q0, v0, 0.5 * a0, c3, c4, c5], axis=-1)


def quintic_system(duration: ArrayLike) -> Array:
    """The confluent Vandermonde matrix M, shape (..., 6, 6), of `M a = (q0, q0', q0'', q1, q1', q1'')`."""
    span = _positive_duration(duration)
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
    t = _positive_duration(duration)
    matrix = quintic_system(t)[..., 3:, 3:]
    rows = [
        [10.0 / t**3, -4.0 / t**2, 0.5 / t],
        [-15.0 / t**4, 7.0 / t**3, -1.0 / t**2],
        [6.0 / t**5, -3.0 / t**4, 0.5 / t**3],
    ]
    return matrix, np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def evaluate(coefficients: ArrayLike, t: ArrayLike, derivative: int = 0) -> Array:
    """A segment, or its derivative of any order, at times t in s from its start.

    The polynomial goes on outside [0, T]; nothing is clamped.

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


def jerk_profile(coefficients: ArrayLike) -> Array:
    """The jerk of quintics as a quadratic in t: `(6 a3, 24 a4, 60 a5)`, shape (..., 3), lowest power first."""
    return differentiate(coefficients, 3)


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
    return extrema(differentiate(coefficients, derivative), _positive_duration(duration))


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


_HERMITE = np.array(
    [[1.0, 0.0, -3.0, 2.0], [0.0, 1.0, -2.0, 1.0], [0.0, 0.0, 3.0, -2.0], [0.0, 0.0, -1.0, 1.0]]
)
"""h00, h10, h01, h11: rows of coefficients, lowest power of s first."""


def _hermite(ends: tuple[Array, Array, Array, Array], span: Array, since: Array, derivative: int) -> Array:
    """All arguments broadcast: the state (q0, v0, q1, v1), the duration, and the time since the start."""
    if derivative not in (0, 1, 2, 3):
        raise ConfigurationError(f"derivative of a cubic is 0, 1, 2 or 3, got {derivative!r}")
    h00, h10, h01, h11 = (value(c, since / span) for c in differentiate(_HERMITE, derivative))
    q0, v0, q1, v1 = ends
    scaled = h00 * q0 + h01 * q1 + span * (h10 * v0 + h11 * v1)
    return np.asarray(scaled / span**derivative)


def hermite(
    q0: ArrayLike,
    v0: ArrayLike,
    q1: ArrayLike,
    v1: ArrayLike,
    duration: ArrayLike,
    t: ArrayLike,
    derivative: int = 0,
) -> Array:
    """The cubic through two positions with two velocities, at times t in s from its start; nothing is clamped.

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
    span, (q0, v0, q1, v1) = _boundary(duration, q0=q0, v0=v0, q1=q1, v1=v1)
    at = np.asarray(t, dtype=np.float64)
    q0, v0, q1, v1, span = (x.reshape((*x.shape, *[1] * at.ndim)) for x in (q0, v0, q1, v1, span))
    return _hermite((q0, v0, q1, v1), span, at, derivative)


def _samples(times: ArrayLike, positions: ArrayLike, velocities: ArrayLike) -> tuple[Array, Array, Array]:
    knots = np.asarray(times, dtype=np.float64)
    q, v = np.asarray(positions, dtype=np.float64), np.asarray(velocities, dtype=np.float64)
    if knots.ndim != 1 or len(knots) < 2:
        raise ConfigurationError(f"times has shape (k,) with k >= 2, got {knots.shape}")
    if not (np.isfinite(knots).all() and (np.diff(knots) > 0.0).all()):
        raise ConfigurationError("times must be finite and strictly rising")
    if q.shape != v.shape or q.ndim == 0 or q.shape[-1] != len(knots):
        raise ConfigurationError(
            f"positions and velocities have shape (..., {len(knots)}), one entry per time on the last axis; "
            f"got {q.shape} and {v.shape}"
        )
    if not (np.isfinite(q).all() and np.isfinite(v).all()):
        raise ConfigurationError("positions and velocities must be finite")
    return knots, q, v


def hermite_series(
    times: ArrayLike, positions: ArrayLike, velocities: ArrayLike, at: ArrayLike, derivative: int = 0
) -> Array:
    """A stream of samples at the times of another one, for example 30 Hz frames at the ticks of a 1 kHz loop.

    Every pair of neighbouring samples is joined by a cubic, so position and velocity are continuous; acceleration
    is not, and at a knot it is that of the segment after it (of the last one at the end). A value between two
    samples needs the later one: a loop that runs in real time is late by up to one sample interval.

    Args:
        times: Sample times in s, strictly rising, evenly spaced or not, shape (k,).
        positions: Shape (..., k).
        velocities: Shape (..., k).
        at: Times asked for, shape () or (m,), within the samples: nothing is extrapolated.
        derivative: By time: 0 for position, 1 velocity, 2 acceleration, 3 jerk.

    Returns:
        Shape (...) for one time, (..., m) for m.

    Raises:
        ConfigurationError: For times that do not rise, shapes that do not fit, values that are not finite, or
            times asked for before the first or after the last sample.
    """
    knots, q, v = _samples(times, positions, velocities)
    asked = np.asarray(at, dtype=np.float64)
    if not ((asked >= knots[0]) & (asked <= knots[-1])).all():
        raise ConfigurationError(
            f"times asked for must lie within the samples, {knots[0]} s to {knots[-1]} s; nothing is extrapolated"
        )
    i = np.clip(np.searchsorted(knots, asked, side="right") - 1, 0, len(knots) - 2)
    ends = (q[..., i], v[..., i], q[..., i + 1], v[..., i + 1])
    return _hermite(ends, knots[i + 1] - knots[i], asked - knots[i], derivative)


def knot_acceleration_step(times: ArrayLike, positions: ArrayLike, velocities: ArrayLike) -> Array:
    """Jump of the acceleration of `hermite_series` at its inner knots, shape (..., k - 2); arguments as there."""
    knots, q, v = _samples(times, positions, velocities)
    span = np.diff(knots)
    ends = (q[..., :-1], v[..., :-1], q[..., 1:], v[..., 1:])
    before, after = _hermite(ends, span, span, 2), _hermite(ends, span, np.zeros_like(span), 2)
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
