"""Watchdog: how long a command may stay in force without renewal, and how far a machine comes within a time.

**Leases.** The distance travelled from the reading of the clearance until full braking, and the stopping distance,
must fit into the clearance:

    travel(lease + detect + hold + age + act) + stopping distance + localisation + margin <= clearance

In the appendix the machine keeps its speed until it brakes; with `acceleration` it may speed up until then. A lease
of zero or less means: revoke now. Rounding only shortens a lease, and inputs that are not finite revoke.

With the delays T_video + T_human + T_act of a remote operator (without the downlink; a reaction takes 0.15 to 0.25 s)
the lease is the longest round trip of the network, `T_RTT <= (D_clear - d_brake) / v - delays`. It bounds
displacement, not energy or contact force.

**Reach.** `furthest` and `admits` are necessary bounds: no reachable goal is refused. `transit_time` asks ruckig.
Metres stand for any unit of length.

Source: appendix "Kinematic derivation of watchdog validity leases", "Teleoperation network round-trip time bounds"
and "Trajectory transit time and reachable distance".
"""

import math

import numpy as np
import ruckig
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.errors import Array

_ROUNDING = 16.0 * float(np.finfo(np.float64).eps)
"""Relative bound on the accumulated rounding of the formulas below."""
_TINY = 1e-300
"""Absolute reserve for subnormal numbers, whose relative precision is lost."""
_LONGEST = 1e300
"""s; largest finite lease, so that nothing overflows."""


def longest_lease(
    clearance: ArrayLike,
    speed: ArrayLike,
    braking: ArrayLike,
    delays_s: ArrayLike,
    localisation: ArrayLike = 0.0,
    margin: ArrayLike = 0.0,
    acceleration: ArrayLike = 0.0,
    top_speed: ArrayLike = np.inf,
) -> Array:
    """The longest T_lease, s, shape (...), after which a machine without renewal still stops inside the clearance.

    With tau = T_lease + delays_s, approach speed v (at most `top_speed`), acceleration a and braking b the travel is
    `v tau + a tau^2 / 2`, the stopping distance `(v + a tau)^2 / (2 b)`. inf for a machine that recedes or stands
    still, cannot accelerate and has room left; -inf where an input (but `top_speed`) is not finite or has a sign that
    makes no sense, and where a machine that does not approach has no room left. Never NaN.

    Args:
        clearance: D_clear as measured `age` ago, m, shape (...).
        speed: Approach speed as measured then, m/s, positive towards the obstacle, shape (...).
        braking: Verified lower bound on the deceleration, m/s^2, shape (...).
        delays_s: T_detect + T_hold + t_age + T_act, s, shape (...).
        localisation: delta_loc, bound on the error of the clearance, m, shape (...).
        margin: delta_margin, clearance at rest, m, shape (...).
        acceleration: Largest approach acceleration that any command may cause until the brakes hold, m/s^2.
        top_speed: Bound on the approach speed that this acceleration may lead to, m/s; a measured speed above it
            counts as the bound. inf: none.
    """
    # Scalar arithmetic: for the few leases of a control step it is faster than arrays.
    given = (clearance, speed, braking, delays_s, localisation, margin, acceleration, top_speed)
    several = np.broadcast(*(np.asarray(x, dtype=np.float64) for x in given))
    return np.array([_lease(*map(float, one)) for one in several]).reshape(several.shape)


def _lease(d: float, v: float, b: float, late: float, loc: float, gap: float, a: float, top: float) -> float:
    """`longest_lease` of one machine."""
    known = all(map(math.isfinite, (d, v, b, late, loc, gap, a)))
    if not (known and b > 0.0 and late >= 0.0 and loc >= 0.0 and gap >= 0.0 and a >= 0.0 and top >= 0.0):
        return -math.inf
    top = max(top, v)
    braking_way = max(v, 0.0) * max(v, 0.0) / (2.0 * b)
    room = d - loc - gap
    room -= _ROUNDING * (abs(d) + loc + gap + braking_way)
    if v <= 0.0:
        if room <= 0.0:
            return -math.inf
        if a == 0.0 or top == 0.0:
            return math.inf
    share = 1.0 / (1.0 + a / b)
    onset = math.hypot(math.sqrt(2.0 * a) * math.sqrt(max(room, 0.0)), v) * math.sqrt(share)
    if onset > top:
        way_to_top = 0.5 * (top - v) * ((top + v) / a)
        stop_from_top = top * top / (2.0 * b)
        left = room - way_to_top - stop_from_top
        left -= _ROUNDING * (abs(way_to_top) + stop_from_top)
        tau = (top - v) / a + left / top
    elif v < 0.0:
        tau = (onset - v) / a
    elif onset + v == 0.0:  # a speed that underflowed counts as unknown
        return -math.inf
    else:
        # Without the difference of two nearly equal speeds, and right for a = 0 too.
        tau = 2.0 * share * (room - braking_way) / (onset + v)
    tau = min(tau, _LONGEST)
    lease = tau - late - _ROUNDING * (abs(tau) + late) - _TINY
    return -math.inf if math.isnan(lease) else lease


def furthest(
    duration: ArrayLike, velocity: ArrayLike, max_speed: ArrayLike, max_acceleration: ArrayLike
) -> tuple[Array, Array]:
    """Bounds on the displacement, m, at any moment within a time, from a moving start to any speed at the end.

    The lowest (<= 0) and the highest (>= 0), shape (...) each; NaN where the velocity is not finite. They are exact:
    no admissible motion gets farther. A start outside the limits widens them.

    All arguments have shapes that broadcast: s (>= 0), m/s (at the start), m/s (> 0, inf: none) and m/s^2 (> 0).
    """
    given = (duration, velocity, max_speed, max_acceleration)
    time, v, v_max, a_max = (np.asarray(x, dtype=np.float64) for x in given)
    with np.errstate(invalid="ignore"):
        return -_highest(time, -v, v_max, a_max), _highest(time, v, v_max, a_max)


def _highest(time: Array, v: Array, v_max: Array, a_max: Array) -> Array:
    """The largest displacement within the time: full acceleration, then full speed."""
    top = np.maximum(v_max, v)
    climb = np.minimum(time, (top - v) / a_max)
    cruise = time - climb
    cruised = np.where(cruise > 0.0, top * cruise, 0.0)
    way = climb * (v + 0.5 * a_max * climb) + cruised
    size = climb * (np.abs(v) + a_max * climb) + np.abs(cruised)
    return np.asarray(np.maximum(way, 0.0) + 2.0 * _ROUNDING * size)


def admits(
    goal: ArrayLike,
    position: ArrayLike,
    velocity: ArrayLike,
    duration: ArrayLike,
    max_speed: ArrayLike,
    max_acceleration: ArrayLike,
) -> NDArray[np.bool_]:
    """Whether a position may be reached within a time, at any speed, axis by axis: a necessary condition.

    False: no admissible motion gets there, or goal, position or velocity are not finite. `goal` and `position` are in
    m, shape (...), the other arguments those of `furthest`.
    """
    lowest, highest = furthest(duration, velocity, max_speed, max_acceleration)
    end, start = np.asarray(goal, dtype=np.float64), np.asarray(position, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        way, slack = end - start, 2.0 * _ROUNDING * (np.abs(end) + np.abs(start))
        return np.asarray((lowest - slack <= way) & (way <= highest + slack) & np.isfinite(way))


def transit_time(
    goal: ArrayLike,
    position: ArrayLike,
    velocity: ArrayLike,
    max_speed: ArrayLike,
    max_acceleration: ArrayLike,
    max_jerk: ArrayLike = math.inf,
) -> float:
    """The shortest time, s, after which all axes, shape (axes,) or scalar, rest at the goal; arguments of `admits`.

    A start that is too fast is first braked. With `max_jerk`, m/s^3, it is one without acceleration. inf where goal,
    position or velocity are not finite, and where ruckig finds no profile.
    """
    given = (goal, position, velocity, max_speed, max_acceleration, max_jerk)
    end, start, v, v_max, a_max, jerk = np.broadcast_arrays(
        *(np.atleast_1d(np.asarray(x, dtype=np.float64)) for x in given)
    )
    if not (np.isfinite(end) & np.isfinite(start) & np.isfinite(v)).all():
        return math.inf
    request, trajectory = ruckig.InputParameter(end.size), ruckig.Trajectory(end.size)
    request.current_position, request.current_velocity, request.target_position = start, v, end
    request.max_velocity, request.max_acceleration, request.max_jerk = v_max, a_max, jerk
    try:
        ruckig.Ruckig(end.size).calculate(request, trajectory)
    except ruckig.RuckigError:
        return math.inf
    return float(trajectory.duration)
