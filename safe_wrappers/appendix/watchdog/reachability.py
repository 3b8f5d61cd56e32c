"""Rest-to-rest moves: shortest time, largest distance, braking distance, and with limited jerk.

Source: appendix "Trajectory transit time and reachable distance". Metres stand for any unit of length.
"""

import numpy as np
import ruckig
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array
from safe_wrappers.control.watchdog.reachability import (
    MotionLimits,
    checked_limits,
    furthest,
    jerk_limited_profile,
)


def stopping_distance(speed: ArrayLike, braking: ArrayLike) -> Array:
    """`v^2 / (2 a_brake)`, 0 for a machine that stands or recedes.

    Args:
        speed: Approach speed v in m/s (or rad/s), shape (...).
        braking: Verified deceleration a_brake in m/s^2, shape (...).

    Returns:
        Distance in m, shape (...); inf where the braking is not positive or an input is not finite.
    """
    v, b = np.asarray(speed, dtype=np.float64), np.asarray(braking, dtype=np.float64)
    known = np.isfinite(v) & np.isfinite(b) & (b > 0.0)
    with np.errstate(over="ignore"):
        way = np.maximum(np.where(known, v, 0.0), 0.0) ** 2 / (2.0 * np.where(known, b, 1.0))
    return np.asarray(np.where(known, way, np.inf))


_HALVINGS = 60
"""Bisections until an interval is as small as rounding."""


def transit_time(distance: ArrayLike, max_acceleration: ArrayLike, max_speed: ArrayLike = np.inf) -> Array:
    """The shortest time of a move from rest to rest: triangular up to `d = v_max^2 / a_max`, then trapezoidal.

    A lower bound for a machine that has other limits besides.

    Args:
        distance: m, of either sign, shape (...).
        max_acceleration: a_max for speeding up and for braking, m/s^2, shape (...).
        max_speed: v_max, m/s, shape (...).

    Returns:
        Time in s, shape (...); inf for a distance that is not finite.

    Raises:
        ConfigurationError: For a limit that is not positive, or an acceleration that is not finite.
    """
    a, v, _ = checked_limits(max_acceleration, max_speed, np.inf)
    d = np.abs(np.asarray(distance, dtype=np.float64))
    d = np.where(np.isfinite(d), d, np.inf)
    with np.errstate(invalid="ignore"):
        time = np.where(d <= v * (v / a), 2.0 * np.sqrt(d / a), d / v + v / a)
    return np.asarray(np.where(np.isinf(d), np.inf, time))


def reachable_distance(
    duration: ArrayLike, max_acceleration: ArrayLike, max_speed: ArrayLike = np.inf
) -> Array:
    """The longest move from rest to rest within a time, the inverse of `transit_time`.

    Args:
        duration: s, shape (...).
        max_acceleration: a_max, m/s^2, shape (...).
        max_speed: v_max, m/s, shape (...).

    Returns:
        Distance in m, shape (...); 0 for a duration that is negative or NaN.

    Raises:
        ConfigurationError: For a limit that is not positive, or an acceleration that is not finite.
    """
    a, v, _ = checked_limits(max_acceleration, max_speed, np.inf)
    time = np.asarray(duration, dtype=np.float64)
    time = np.maximum(np.where(np.isnan(time), 0.0, time), 0.0)
    with np.errstate(invalid="ignore", over="ignore"):
        return np.asarray(np.where(time <= 2.0 * (v / a), 0.25 * a * time**2, v * (time - v / a)))


def jerk_limited_reach(
    duration: ArrayLike, start_velocity: ArrayLike, start_acceleration: ArrayLike, limits: MotionLimits
) -> tuple[Array, Array]:
    """The lowest and the highest displacement at which an axis can be at rest within a time.

    All rest positions between the two can be reached as well, as long as the start keeps the limits: the motions are
    a convex set. Found by bisection over ruckig's times, on the inner side.

    Args:
        duration: s, shape (...).
        start_velocity: m/s, shape (...).
        start_acceleration: m/s^2, shape (...).
        limits: Of every axis.

    Returns:
        Lowest and highest displacement in m, shape (...). Where the time does not suffice to stop at all, or an input
        is not finite, the empty interval (inf, -inf).

    Raises:
        ConfigurationError: Where ruckig finds no profile.
    """
    given = [np.asarray(x, dtype=np.float64) for x in (duration, start_velocity, start_acceleration)]
    time, v, a, a_max, v_max, jerk = np.broadcast_arrays(*given, *limits.arrays)
    lowest, highest = np.full(time.shape, np.inf), np.full(time.shape, -np.inf)
    for i in np.ndindex(time.shape):
        if np.isfinite([time[i], v[i], a[i]]).all():
            ends = _rest_ends(
                float(time[i]), float(v[i]), float(a[i]), (float(a_max[i]), float(v_max[i]), float(jerk[i]))
            )
            if ends is not None:
                lowest[i], highest[i] = ends
    return lowest, highest


def _rest_ends(
    time: float, v: float, a: float, limits: tuple[float, float, float]
) -> tuple[float, float] | None:
    a_max, v_max, jerk = limits
    axis = tuple(np.array([x]) for x in limits)
    start = (np.zeros(1), np.array([v]), np.array([a]))
    nothing = np.zeros(1)
    stop = jerk_limited_profile(start, (nothing, nothing, nothing), axis, ruckig.ControlInterface.Velocity)
    if stop.duration > time:
        return None
    at_stop = float(stop.at_time(stop.duration)[0][0])

    def inside(position: float) -> bool:
        return bool(
            jerk_limited_profile(start, (np.array([position]), nothing, nothing), axis).duration <= time
        )

    ends = []
    for beyond in furthest(time, v, a, v_max, a_max, jerk):
        reached, missed = at_stop, float(beyond)
        for _ in range(_HALVINGS):
            middle = 0.5 * (reached + missed)
            reached, missed = (middle, missed) if inside(middle) else (reached, middle)
        ends.append(reached)
    return ends[0], ends[1]
