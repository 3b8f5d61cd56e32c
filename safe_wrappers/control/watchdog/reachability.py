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
    duration: ArrayLike,
    velocity: ArrayLike,
    acceleration: ArrayLike,
    max_speed: ArrayLike,
    max_acceleration: ArrayLike,
    max_jerk: ArrayLike = np.inf,
) -> tuple[Array, Array]:
    """Bounds on the displacement, m, at any moment within a time, from a moving start to any speed at the end.

    The lowest (<= 0) and the highest (>= 0), shape (...) each; (inf, -inf) where the duration is negative or anything
    is not finite. No admissible motion gets farther; the bound is exact where the speed limit is not reached or the
    jerk not limited. A start outside the limits widens them.

    Args:
        duration: s, shape (...).
        velocity: At the start, m/s, shape (...).
        acceleration: At the start, m/s^2, shape (...); without effect if the jerk is not limited.
        max_speed: m/s, shape (...); inf: none.
        max_acceleration: m/s^2, shape (...), finite.
        max_jerk: m/s^3, shape (...); inf: none.
    """
    a_max, v_max, jerk = checked_limits(max_acceleration, max_speed, max_jerk)
    time, v, a = (np.asarray(x, dtype=np.float64) for x in (duration, velocity, acceleration))
    known = np.isfinite(time) & np.isfinite(v) & np.isfinite(a) & (time >= 0.0)
    time, v, a = (np.where(known, x, 0.0) for x in (time, v, a))
    up, down = _highest(time, v, a, v_max, a_max, jerk), _highest(time, -v, -a, v_max, a_max, jerk)
    known = np.broadcast_to(known, up.shape)
    return np.where(known, -down, np.inf), np.where(known, up, -np.inf)


def _highest(time: Array, v: Array, a: Array, v_max: Array, a_max: Array, jerk: Array) -> Array:
    """The largest displacement of the upper envelope within the time."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        # Without a limit on the jerk the envelope starts at full acceleration: a ramp of no length.
        free = np.isinf(jerk)
        a = np.where(free, a_max, a)
        j = np.where(free, 1.0, jerk)
        a_max = np.maximum(a_max, a)
        growing = np.where(free, 0.0, np.maximum(a, 0.0))
        v_max = np.maximum(v_max, v + 0.5 * growing * (growing / j))
        ramp = (a_max - a) / j
        gain = v_max - v
        root = np.sqrt(a * a + 2.0 * j * gain)
        rising = np.where(a > 0.0, 2.0 * gain / (a + root), (root - a) / j)
        after = v + ramp * (a + 0.5 * j * ramp)
        full = np.where(rising <= ramp, rising, ramp + (v_max - after) / a_max)
        climb = np.minimum(time, full)
        first = np.minimum(climb, ramp)
        second = climb - first
        at_end = first * (v + first * (0.5 * a + j / 6.0 * first))
        at_end = at_end + second * (v + first * (a + 0.5 * j * first) + 0.5 * a_max * second)
        cruise = time - climb
        at_end = at_end + np.where(cruise > 0.0, v_max * cruise, 0.0)
        # Braking at the start: the highest point may be where the motion reverses.
        square = a * a - 2.0 * j * v
        turn = 2.0 * v / (np.sqrt(np.maximum(square, 0.0)) - a)
        turns = (v > 0.0) & (a < 0.0) & (square > 0.0)
        turn = np.minimum(np.where(turns, turn, 0.0), time)
        at_turn = turn * (v + turn * (0.5 * a + j / 6.0 * turn))
        peak = np.maximum(np.maximum(at_end, at_turn), 0.0)
        speeds = np.abs(v) + climb * (np.abs(a) + a_max)
        size = speeds * climb + np.where(cruise > 0.0, v_max * cruise, 0.0)
        return np.asarray(peak + _ROUNDING * size)


def admits(
    goal: ArrayLike,
    position: ArrayLike,
    velocity: ArrayLike,
    duration: ArrayLike,
    max_speed: ArrayLike,
    max_acceleration: ArrayLike,
    max_jerk: ArrayLike = np.inf,
    acceleration: ArrayLike | None = 0.0,
) -> NDArray[np.bool_]:
    """Whether a position may be reached within a time, at any speed, axis by axis: a necessary condition.

    False: no admissible motion gets there, anything is not finite, or the duration is negative. `goal` and `position`
    are in m, shape (...), the other arguments those of `furthest`. An acceleration of None is not measured: the
    largest one is assumed, and the jerk limit only matters for a start above the speed limit.
    """
    if acceleration is None:
        a_max, v_max, jerk = checked_limits(max_acceleration, max_speed, max_jerk)
        v = np.asarray(velocity, dtype=np.float64)
        # A start inside the limits stays inside: without a limit on the jerk.
        _, highest = furthest(duration, v, a_max, v_max, a_max, np.where(v > v_max, jerk, np.inf))
        lowest, _ = furthest(duration, v, -a_max, v_max, a_max, np.where(v < -v_max, jerk, np.inf))
    else:
        lowest, highest = furthest(duration, velocity, acceleration, max_speed, max_acceleration, max_jerk)
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
