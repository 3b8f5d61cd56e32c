"""The smoothstep blend of two commands, and the shortest blend between commands that move.

Source: appendix "Bumpless transfer and smoothstep blending".
"""

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, finite_arrays
from safe_wrappers.control.handover.polynomials import bracketed_root
from safe_wrappers.control.handover.smoothstep import ROUND_UP, check_positive, smoothstep


def blend(prior: ArrayLike, new: ArrayLike, s: ArrayLike) -> Array:
    """(1 - alpha(s)) prior + alpha(s) new, never outside the range of the two.

    The prior command bit for bit at s <= 0 and where both are equal, the new one bit for bit at s >= 1.
    """
    prior, new = np.asarray(prior, dtype=np.float64), np.asarray(new, dtype=np.float64)
    alpha = smoothstep(s)
    between = np.clip(prior + alpha * (new - prior), np.minimum(prior, new), np.maximum(prior, new))
    return np.asarray(np.where(alpha >= 1.0, new, between))


def blend_rate(
    prior: ArrayLike,
    prior_rate: ArrayLike,
    new: ArrayLike,
    new_rate: ArrayLike,
    s: ArrayLike,
    duration: ArrayLike,
) -> Array:
    """Time derivative of the blended command, units of u per s.

    `alpha'(s) / tau (u_new - u_prior) + (1 - alpha(s)) u_prior' + alpha(s) u_new'`, where the commands and their
    rates are those at the moment s. Where u is an acceleration, this is the commanded jerk.

    Args:
        prior: The command that is handed over, at s.
        prior_rate: Its time derivative at s.
        new: The command that takes over, at s.
        new_rate: Its time derivative at s.
        s: Normalised time.
        duration: Blend time tau in s, > 0; left unchecked here.
    """
    step = np.asarray(new, dtype=np.float64) - np.asarray(prior, dtype=np.float64)
    alpha = smoothstep(s)
    own = (1.0 - alpha) * np.asarray(prior_rate, dtype=np.float64) + alpha * np.asarray(
        new_rate, dtype=np.float64
    )
    return np.asarray(smoothstep(s, 1) / np.asarray(duration, dtype=np.float64) * step + own)


def _steepest(step: Array, prior_rate: Array, new_rate: Array, limit: Array) -> Array:
    """Largest w = 1 / tau for which the rate of a blend up by `step` > 0 stays <= limit; may be negative.

    With G = alpha + s alpha' the rate is `30 s^2 (1 - s)^2 step w + prior_rate + G(s) dr`, dr the difference of the
    rates, so w is at most `phi(s) = (limit - prior_rate - G dr) / (30 s^2 (1 - s)^2 step)` for every s. phi has one
    minimum. With x the distance from the end whose rate is the larger one, and b the room that the limit leaves
    there, it lies at `|dr| x^3 R(x) = b (1 - 2 x)`, R = 20 - 55 x + 54 x^2 - 18 x^3, whose left side rises and whose
    right side falls over [0, 1/2]. (x = s if dr < 0, and then G = x^3 (40 - 75 x + 36 x^2); x = 1 - s if dr > 0, and
    then G - 1 = x^2 (30 - 100 x + 105 x^2 - 36 x^3): near the end nothing cancels.)
    """
    change = new_rate - prior_rate
    room = limit - np.maximum(prior_rate, new_rate)
    size = np.abs(change)
    scale = np.where(size + room > 0.0, size + room, 1.0)
    a, b = size / scale, room / scale
    zero = np.zeros_like(a)
    equation = np.stack([-b, 2.0 * b, zero, 20.0 * a, -55.0 * a, 54.0 * a, -18.0 * a], axis=-1)
    half = zero + 0.5
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        guess = np.cbrt(b / (20.0 * a))
    x = bracketed_root(equation, zero, half, np.where(guess < 0.5, guess, half))
    x = np.where(size > 0.0, x, half)
    from_room = np.divide(room, x**2, out=np.zeros_like(room), where=room > 0.0)
    rising = 30.0 + x * (-100.0 + x * (105.0 - 36.0 * x))
    falling = x * (40.0 + x * (-75.0 + 36.0 * x))
    own = np.where(change > 0.0, -size * rising, size * falling)
    with np.errstate(over="ignore"):
        return np.asarray((from_room + own) / (30.0 * step * (1.0 - x) ** 2))


def moving_blend_interval(
    prior: ArrayLike,
    prior_rate: ArrayLike,
    new: ArrayLike,
    new_rate: ArrayLike,
    rate_limit: ArrayLike,
) -> tuple[Array, Array]:
    """All blend times that keep the command's rate within a limit while both commands move: shortest, longest.

    Both commands move at constant rates, u(t) = u + rate t from the blend's start. At every s the rate of the
    blended command is affine in 1 / tau, so the admissible blend times form one interval. A blend can also be
    too long: the commands drift apart while it lasts, and a blend adds up to 7/9 of the difference of their
    rates to the larger one. Commands of several components need a time within all their intervals.

    Args:
        prior: The command that is handed over, at the blend's start, units of u.
        prior_rate: Its rate, units of u per s.
        new: The command that takes over, at the blend's start.
        new_rate: Its rate.
        rate_limit: Largest admissible |du/dt|, > 0.

    Returns:
        The shortest and the longest admissible blend time in s. `(inf, inf)` where none is: an endpoint itself
        is faster than the limit, or the two drift apart. `(0, ...)` where the commands meet at the start: switch
        at once; the longest is then 0 if no blend at all is admissible, else inf. Rounded inwards in the twelfth
        digit, so both ends keep the limit.

    Raises:
        ConfigurationError: For a limit that is not positive, or input that is not finite.
    """
    prior, prior_rate, new, new_rate, limit = finite_arrays(
        prior=prior, prior_rate=prior_rate, new=new, new_rate=new_rate, rate_limit=rate_limit
    )
    check_positive("rate_limit", limit)
    step = new - prior
    up = np.where(step < 0.0, -1.0, 1.0)
    start, end = up * prior_rate, up * new_rate
    moves = step != 0.0
    size = np.where(moves, np.abs(step), 1.0)
    slow = np.maximum(np.abs(start), np.abs(end)) <= limit
    start, end = np.where(slow, start, 0.0), np.where(slow, end, 0.0)

    highest = _steepest(size, start, end, limit)
    lowest = np.maximum(-_steepest(size, -start, -end, limit), 0.0)
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        shortest = np.where(highest > 0.0, 1.0 / highest * ROUND_UP, np.inf)
        longest = np.where(lowest > 0.0, 1.0 / lowest / ROUND_UP, np.inf)
    possible = slow & (shortest <= longest) & np.isfinite(shortest)
    shortest, longest = np.where(possible, shortest, np.inf), np.where(possible, longest, np.inf)

    # without a step only the drift counts: it is largest at s = 2/3, where G = 16/9
    drift = np.abs(start + 16.0 / 9.0 * (end - start)) <= limit
    shortest = np.where(slow & ~moves, 0.0, shortest)
    longest = np.where(slow & ~moves, np.where(drift, np.inf, 0.0), longest)
    return np.asarray(shortest), np.asarray(longest)


def shortest_moving_blend(
    prior: ArrayLike,
    prior_rate: ArrayLike,
    new: ArrayLike,
    new_rate: ArrayLike,
    rate_limit: ArrayLike,
) -> Array:
    """Shortest blend time in s between two commands that move at constant rates; inf where none is admissible.

    The first part of `moving_blend_interval`, which see: a longer blend than this one is not always admissible.
    Equals `shortest_latched_blend` where both rates are 0.
    """
    return moving_blend_interval(prior, prior_rate, new, new_rate, rate_limit)[0]
