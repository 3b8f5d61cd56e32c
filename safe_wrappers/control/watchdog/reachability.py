"""Reachability in time: bounds on the displacement within a time, and jerk-limited motion times.

Source: appendix "Trajectory transit time and reachable distance". `furthest` and `admits` are necessary bounds: no
reachable goal is refused. `jerk_limited_time` is solved by ruckig. Metres stand for any unit of length.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import ruckig
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError

State = tuple[ArrayLike, ArrayLike, ArrayLike]
"""Position (m), velocity (m/s), acceleration (m/s^2), each of shape (axes,) or scalar."""

_ROUNDING = 32.0 * float(np.finfo(np.float64).eps)
"""Relative bound on the accumulated rounding below."""


@dataclass(frozen=True)
class MotionLimits:
    """Symmetric limits of every axis, positive; scalars apply to all of them.

    Attributes:
        max_acceleration: m/s^2, finite.
        max_speed: m/s; inf: none.
        max_jerk: m/s^3; inf: none.
    """

    max_acceleration: float | Sequence[float]
    max_speed: float | Sequence[float] = math.inf
    max_jerk: float | Sequence[float] = math.inf
    arrays: tuple[Array, Array, Array] = field(init=False, repr=False, compare=False)
    """Acceleration, speed, jerk."""

    def __post_init__(self) -> None:
        checked = checked_limits(self.max_acceleration, self.max_speed, self.max_jerk)
        object.__setattr__(self, "arrays", checked)


def furthest(
    duration: ArrayLike, velocity: ArrayLike, max_speed: ArrayLike, max_acceleration: ArrayLike
) -> tuple[Array, Array]:
    """Bounds on the displacement, m, at any moment within a time, from a moving start to any speed at the end.

    The lowest (<= 0) and the highest (>= 0), shape (...) each; (inf, -inf) where the duration is negative or anything
    is not finite. They are exact: no admissible motion gets farther. A start outside the limits widens them.

    Args:
        duration: s, shape (...).
        velocity: At the start, m/s, shape (...).
        max_speed: m/s, shape (...); inf: none.
        max_acceleration: m/s^2, shape (...), finite.
    """
    a_max, v_max, _ = checked_limits(max_acceleration, max_speed, np.inf)
    time, v = (np.asarray(x, dtype=np.float64) for x in (duration, velocity))
    known = np.isfinite(time) & np.isfinite(v) & (time >= 0.0)
    time, v = (np.where(known, x, 0.0) for x in (time, v))
    up, down = _highest(time, v, v_max, a_max), _highest(time, -v, v_max, a_max)
    known = np.broadcast_to(known, up.shape)
    return np.where(known, -down, np.inf), np.where(known, up, -np.inf)


def _highest(time: Array, v: Array, v_max: Array, a_max: Array) -> Array:
    """The largest displacement within the time: full acceleration, then full speed."""
    top = np.maximum(v_max, v)
    climb = np.minimum(time, (top - v) / a_max)
    cruise = time - climb
    with np.errstate(invalid="ignore"):
        cruised = np.where(cruise > 0.0, top * cruise, 0.0)
    way = climb * (v + 0.5 * a_max * climb) + cruised
    size = climb * (np.abs(v) + a_max * climb) + np.abs(cruised)
    return np.asarray(np.maximum(way, 0.0) + _ROUNDING * size)


def admits(
    goal: ArrayLike,
    position: ArrayLike,
    velocity: ArrayLike,
    duration: ArrayLike,
    max_speed: ArrayLike,
    max_acceleration: ArrayLike,
) -> NDArray[np.bool_]:
    """Whether a position may be reached within a time, at any speed, axis by axis: a necessary condition.

    False: no admissible motion gets there, anything is not finite, or the duration is negative. `goal` and `position`
    are in m, shape (...), the other arguments those of `furthest`.
    """
    lowest, highest = furthest(duration, velocity, max_speed, max_acceleration)
    end, start = np.asarray(goal, dtype=np.float64), np.asarray(position, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        way, slack = end - start, _ROUNDING * (np.abs(end) + np.abs(start))
        return np.asarray((lowest - slack <= way) & (way <= highest + slack) & np.isfinite(way))


def jerk_limited_time(start: State, end: State, limits: MotionLimits) -> float:
    """The shortest time, s, in which all axes arrive at their end state together.

    A start outside the limits is first brought back inside. inf where a state is not finite, and where the end state
    violates the limits: too fast, too strongly accelerated, or reached only from above the speed limit.

    Args:
        start: Position, velocity, acceleration, of each axis.
        end: Likewise.
        limits: Of every axis.

    Raises:
        ConfigurationError: Where the shapes do not fit together, or ruckig finds no profile for other reasons.
    """
    given = [np.atleast_1d(np.asarray(x, dtype=np.float64)) for x in (*start, *end, *limits.arrays)]
    try:
        p0, v0, a0, p1, v1, a1, a_max, v_max, jerk = np.broadcast_arrays(*given)
    except ValueError:
        shapes = ", ".join(str(x.shape) for x in given)
        raise ConfigurationError(f"states, limits need shapes that fit together, got {shapes}") from None
    with np.errstate(invalid="ignore", over="ignore"):
        # With an end acceleration against the motion, the speed before was higher.
        before = np.where(v1 * a1 < 0.0, 0.5 * a1 * (a1 / jerk), 0.0)
        possible = (np.abs(v1) + before <= v_max) & (np.abs(a1) <= a_max)
    if not (possible.all() and all(np.isfinite(x).all() for x in (p0, v0, a0, p1, v1, a1))):
        return math.inf
    request, trajectory = ruckig.InputParameter(p0.size), ruckig.Trajectory(p0.size)
    request.current_position, request.current_velocity, request.current_acceleration = p0, v0, a0
    request.target_position, request.target_velocity, request.target_acceleration = p1, v1, a1
    request.max_acceleration, request.max_velocity, request.max_jerk = a_max, v_max, jerk
    try:
        ruckig.Ruckig(p0.size).calculate(request, trajectory)
    except ruckig.RuckigError as error:
        reason = str(error).strip().splitlines()[0]
        raise ConfigurationError(
            f"ruckig found no profile from {start} to {end} (position, velocity, acceleration) within {limits}: "
            f"{reason}"
        ) from error
    return float(trajectory.duration)


def checked_limits(
    max_acceleration: ArrayLike, max_speed: ArrayLike, max_jerk: ArrayLike
) -> tuple[Array, Array, Array]:
    """Acceleration (finite), speed and jerk limits as float64, all positive."""
    named = {"max_acceleration": max_acceleration, "max_speed": max_speed, "max_jerk": max_jerk}
    checked = []
    for name, value in named.items():
        array = np.asarray(value, dtype=np.float64)
        finite = name == "max_acceleration"
        if not np.all((array > 0.0) & (np.isfinite(array) if finite else True)):
            kind = "positive and finite" if finite else "positive (inf: no limit)"
            raise ConfigurationError(f"{name} must be {kind}, got {value!r}")
        checked.append(array)
    return checked[0], checked[1], checked[2]
