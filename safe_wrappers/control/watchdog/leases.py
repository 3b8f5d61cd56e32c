"""Watchdog leases: how long a command may stay in force without renewal.

Source: appendix "Kinematic derivation of watchdog validity leases" and "Teleoperation network round-trip time
bounds". The distance travelled from the reading of the clearance until full braking, and the stopping distance, must
fit into the clearance:

    travel(lease + detect + hold + age + act) + stopping distance + localisation + margin <= clearance

In the appendix the machine keeps its speed until it brakes; with `acceleration` it may speed up until then. A lease
of zero or less means: revoke now. Rounding only shortens a lease, and inputs that are not finite revoke.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError

_ROUNDING = 16.0 * float(np.finfo(np.float64).eps)
"""Relative bound on the accumulated rounding of the formulas below."""
_TINY = 1e-300
"""Absolute reserve for subnormal numbers, whose relative precision is lost."""
_LONGEST = 1e300
"""s; largest finite lease, so that nothing overflows."""
_AT_ONCE = 1e300
"""m/s^2; a braking that takes no way."""


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
    still, cannot accelerate and has room left; -inf where an input (but `top_speed`) is not finite, where the braking
    is not positive, and where a machine that does not approach has no room left. Never NaN.

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

    Raises:
        ConfigurationError: For a negative delay, localisation bound, margin, acceleration or top speed.
    """
    given = (clearance, speed, braking, delays_s, localisation, margin, acceleration, top_speed)
    # Scalar arithmetic: for the few leases of a control step it is faster than arrays.
    several = np.broadcast(*(np.asarray(x, dtype=np.float64) for x in given))
    _not_negative(delays_s=delays_s, localisation=localisation, margin=margin)
    _not_negative(acceleration=acceleration, top_speed=top_speed)
    return np.array([_lease_or_none(*map(float, one)) for one in several]).reshape(several.shape)


def _lease_or_none(*machine: float) -> float:
    try:
        return _lease(*machine)
    except ZeroDivisionError:  # a speed that underflowed counts as unknown
        return -math.inf


def _lease(d: float, v: float, b: float, late: float, loc: float, gap: float, a: float, top: float) -> float:
    """`longest_lease` of one machine."""
    if not (all(map(math.isfinite, (d, v, b, late, loc, gap, a))) and b > 0.0) or math.isnan(top):
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
    else:
        # Without the difference of two nearly equal speeds, and right for a = 0 too.
        tau = 2.0 * share * (room - braking_way) / (onset + v)
    tau = min(tau, _LONGEST)
    lease = tau - late - _ROUNDING * (abs(tau) + late) - _TINY
    return -math.inf if math.isnan(lease) else lease


def round_trip_ceiling(
    clearance: ArrayLike,
    speed: ArrayLike,
    braking: ArrayLike,
    video_s: ArrayLike,
    human_s: ArrayLike,
    act_s: ArrayLike,
    localisation: ArrayLike = 0.0,
    margin: ArrayLike = 0.0,
) -> Array:
    """The longest network round trip, s, shape (...), at which a remote operator can still stop the machine in time.

    Downlink and uplink together, `T_RTT <= (D_clear - d_brake) / v - (T_video + T_human + T_act)`. `video_s` lasts
    from the exposure to the operator's display without the downlink, `human_s` is the reaction (0.15 to 0.25 s in the
    appendix), `act_s` lasts until full deceleration; s, at least 0, shape (...). Other arguments, values and errors
    are those of `longest_lease`. It bounds displacement, not energy or contact force.
    """
    _not_negative(video_s=video_s, human_s=human_s, act_s=act_s)
    video, human, act = (np.asarray(late, dtype=np.float64) for late in (video_s, human_s, act_s))
    with np.errstate(over="ignore"):
        late = video + human + act
    return longest_lease(clearance, speed, braking, late, localisation, margin)


def longest_lease_of_room(room: ArrayLike, closing_speed: ArrayLike, delays_s: ArrayLike) -> Array:
    """The longest lease, s, shape (...), from a barrier that includes the stopping distance: `h / closing - delays`.

    Where h cannot fall (closing speed <= 0): inf if it is positive, else -inf; -inf for inputs that are not finite.

    Args:
        room: Value h of the barrier, the clearance left after braking, in any unit U, shape (...).
        closing_speed: Bound on how fast h may fall under any command until the brakes hold, U/s, shape (...).
        delays_s: The other four delays, s, at least 0, shape (...).
    """
    return longest_lease(room, closing_speed, _AT_ONCE, delays_s)


def _not_negative(**values: ArrayLike) -> None:
    for name, value in values.items():
        # Empty arrays, of no surface near, pass.
        least = value if isinstance(value, float) else np.min(np.asarray(value, np.float64), initial=np.inf)
        if least < 0.0:
            raise ConfigurationError(f"{name} must not be negative, got {least:g}")
