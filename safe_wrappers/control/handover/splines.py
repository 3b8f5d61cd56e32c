"""Quintic and cubic Hermite segments in closed form.

Boundary values have any shape (...) that broadcasts, the duration (s, > 0) among them. Times of evaluation are common
to the whole batch, and their axes come last. Positions in any unit q, velocities in q/s, and so on. Neither keeps
limits between its ends (`interior`).

Source: appendix "Smooth Trajectories and Bumpless Transfer".
"""

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, finite_array, finite_arrays
from safe_wrappers.errors import ConfigurationError


def differentiate(coefficients: ArrayLike, times: int = 1) -> Array:
    """Coefficients of the derivative; a constant's is the constant 0."""
    c = np.asarray(coefficients, dtype=np.float64)
    for _ in range(times):
        c = c[..., 1:] * np.arange(1, c.shape[-1]) if c.shape[-1] > 1 else np.zeros_like(c)
    return c


def value(coefficients: Array, x: ArrayLike) -> Array:
    """The polynomials at x, which broadcasts with the batch axes (Horner's scheme)."""
    x = np.asarray(x, dtype=np.float64)
    total = coefficients[..., -1] + 0.0 * x
    for power in range(coefficients.shape[-1] - 2, -1, -1):
        total = total * x + coefficients[..., power]
    return np.asarray(total)


def positive_duration(duration: ArrayLike) -> Array:
    """Durations in s as float64, finite and > 0."""
    try:
        span = np.asarray(duration, dtype=np.float64)
    except (TypeError, ValueError):
        raise ConfigurationError(f"duration is a time in seconds, got {duration!r}") from None
    if not (np.isfinite(span).all() and (span > 0.0).all()):
        raise ConfigurationError(f"duration is a time in seconds, > 0 and finite; got {span}")
    return span


def quintic_coefficients(
    q0: ArrayLike,
    v0: ArrayLike,
    a0: ArrayLike,
    q1: ArrayLike,
    v1: ArrayLike,
    a1: ArrayLike,
    duration: ArrayLike,
) -> Array:
    """Coefficients (..., 6), lowest power of t first, of the quintic through two states.

    Position q, velocity v and acceleration a, shape (...), at t = 0 (q0, v0, a0) and at the duration, s (q1, v1, a1).

    Raises:
        ConfigurationError: A duration that is not positive, values that are not finite, shapes that do not broadcast.
    """
    span = positive_duration(duration)
    span, q0, v0, a0, q1, v1, a1 = finite_arrays(duration=span, q0=q0, v0=v0, a0=a0, q1=q1, v1=v1, a1=a1)
    way, half = q1 - q0, 0.5 * span**2
    c3 = (10.0 * way - (6.0 * v0 + 4.0 * v1) * span - (3.0 * a0 - a1) * half) / span**3
    c4 = (-15.0 * way + (8.0 * v0 + 7.0 * v1) * span + (3.0 * a0 - 2.0 * a1) * half) / span**4
    c5 = (6.0 * way - 3.0 * (v0 + v1) * span - (a0 - a1) * half) / span**5
    return np.stack([q0, v0, 0.5 * a0, c3, c4, c5], axis=-1)


def hermite_coefficients(
    q0: ArrayLike, v0: ArrayLike, q1: ArrayLike, v1: ArrayLike, duration: ArrayLike
) -> Array:
    """Coefficients (..., 4), lowest power of t first, of the cubic through two positions with two velocities.

    Arguments and errors as `quintic_coefficients`.
    """
    span = positive_duration(duration)
    span, q0, v0, q1, v1 = finite_arrays(duration=span, q0=q0, v0=v0, q1=q1, v1=v1)
    way = q1 - q0
    c2 = (3.0 * way - (2.0 * v0 + v1) * span) / span**2
    c3 = (-2.0 * way + (v0 + v1) * span) / span**3
    return np.stack([q0, v0, c2, c3], axis=-1)


_HERMITE = np.array([[1, 0, -3, 2], [0, 1, -2, 1], [0, 0, 3, -2], [0, 0, -1, 1]], dtype=np.float64)
"""h00, h10, h01, h11: rows of coefficients, lowest power of s first."""


def hermite_at(ends: tuple[Array, Array, Array, Array], span: Array, since: Array, derivative: int) -> Array:
    """The cubic of a state (q0, v0, q1, v1) over a duration, `since` its start, or its derivative; all broadcast."""
    if derivative not in (0, 1, 2, 3):
        raise ConfigurationError(f"derivative of a cubic is 0, 1, 2 or 3, got {derivative!r}")
    h00, h10, h01, h11 = (value(c, since / span) for c in differentiate(_HERMITE, derivative))
    q0, v0, q1, v1 = ends
    scaled = h00 * q0 + h01 * q1 + span * (h10 * v0 + h11 * v1)
    return np.asarray(scaled / span**derivative)


def checked_samples(
    times: ArrayLike, positions: ArrayLike, velocities: ArrayLike
) -> tuple[Array, Array, Array]:
    """Knots (k,), positions and velocities (..., k) of a sampled stream.

    Raises:
        ConfigurationError: For times that do not rise, shapes that do not fit, or values that are not finite.
    """
    knots = finite_array("times", times)
    q, v = finite_array("positions", positions), finite_array("velocities", velocities)
    if knots.ndim != 1 or len(knots) < 2:
        raise ConfigurationError(f"times has shape (k,) with k >= 2, got {knots.shape}")
    if not (np.diff(knots) > 0.0).all():
        raise ConfigurationError("times must be strictly rising")
    if q.shape != v.shape or q.ndim == 0 or q.shape[-1] != len(knots):
        wanted = f"(..., {len(knots)}), one entry per time on the last axis"
        raise ConfigurationError(f"positions and velocities have shape {wanted}; got {q.shape} and {v.shape}")
    return knots, q, v


def hermite_series(
    times: ArrayLike, positions: ArrayLike, velocities: ArrayLike, at: ArrayLike, derivative: int = 0
) -> Array:
    """Samples interpolated at other times, shape (...) for one time, (..., m) for m.

    Neighbouring samples are joined by a cubic; acceleration at a knot is that of the following segment.

    Args:
        times: Sample times in s, strictly rising, evenly spaced or not, shape (k,).
        positions: Shape (..., k).
        velocities: Shape (..., k).
        at: Times, shape () or (m,), within the samples.
        derivative: By time: 0 for position, 1 velocity, 2 acceleration, 3 jerk.

    Raises:
        ConfigurationError: As `checked_samples`, and for times before the first or after the last sample.
    """
    knots, q, v = checked_samples(times, positions, velocities)
    asked = np.asarray(at, dtype=np.float64)
    if not ((asked >= knots[0]) & (asked <= knots[-1])).all():
        raise ConfigurationError(f"times lie within {knots[0]} s to {knots[-1]} s; nothing is extrapolated")
    i = np.clip(np.searchsorted(knots, asked, side="right") - 1, 0, len(knots) - 2)
    ends = (q[..., i], v[..., i], q[..., i + 1], v[..., i + 1])
    return hermite_at(ends, knots[i + 1] - knots[i], asked - knots[i], derivative)
