"""Leases: the inequality in exact fractions, and machines that stop at the margin or hit."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from safe_wrappers.control.watchdog import longest_lease

POSITIVE = st.floats(1e-3, 1e3)
SMALL = st.floats(0.0, 2.0)


def used(lease, speed, braking, delays, localisation, margin, acceleration, top=None):
    """The left side of the inequality, in exact fractions, with the highest point of a motion that turns round."""
    v, b, a = Fraction(speed), Fraction(braking), Fraction(acceleration)
    tau = Fraction(lease) + Fraction(delays)
    fixed = Fraction(localisation) + Fraction(margin)
    if top is not None and a > 0 and v + a * tau > Fraction(top):
        top = max(Fraction(top), v)
        until = (top - v) / a
        return v * until + a * until**2 / 2 + top * (tau - until) + top**2 / (2 * b) + fixed
    way = v * tau + a * tau**2 / 2 + max(v + a * tau, Fraction(0)) ** 2 / (2 * b)
    return max(way, Fraction(0)) + fixed


@given(
    st.floats(0.0, 1e4, allow_subnormal=False),
    st.floats(-50.0, 50.0),
    POSITIVE,
    SMALL,
    st.one_of(SMALL, st.floats(0.0, 1e4)),
    SMALL,
    st.one_of(st.just(0.0), st.floats(1e-9, 1e3)),
    st.one_of(st.none(), st.floats(0.0, 60.0)),
)
@example(10.0, 2.0, 1.0, 0.5, 0.0, 0.0, 1e-12, None)
@example(
    969.8092425150087,
    32.21112267875126,
    0.6125947561513535,
    0.0,
    122.92057180858407,
    0.03305527105705819,
    0.0,
    None,
)
@example(
    3024.152304640018,
    45.72502328660836,
    1.2526079739576417,
    0.0,
    2188.4896829519953,
    1.0872499829308457,
    0.0,
    None,
)
@example(1e-300, 0.0, 1.0, 0.0, 0.0, 0.0, 1e-200, None)
@example(2.0, 0.0, 1.0, 0.0, 1.999999999999, 0.0, 1e-9, None)  # room of 1e-12 m, known to 1e-14 m
def test_the_lease_is_the_longest_that_keeps_the_inequality(d, v, b, delays, loc, gap, a, top):
    lease = float(longest_lease(d, v, b, delays, loc, gap, a, np.inf if top is None else top))
    assume(np.isfinite(lease) and lease > 0.0)
    rest = (v, b, delays, loc, gap, a, top)
    assert used(lease, *rest) <= Fraction(d)  # exactly: not one rounding too long
    assume(lease < 1e299)  # a machine that creeps: the longest lease that is still a number
    # Longer by a rounding of the times, it ends no more than one of the distances before the wall.
    longer, rounding = lease + 1e-9 * (lease + delays), 1e-14 * (d + loc + gap + v * v / (2.0 * b))
    assert used(longer, *rest) > Fraction(d) - Fraction(rounding)


def test_the_appendix_formula():
    # (10 - 0.3 - 0.2 - 4 / 4) / 2 - 0.6, by hand
    assert longest_lease(10.0, 2.0, 2.0, 0.1 + 0.2 + 0.05 + 0.25, 0.3, 0.2) == pytest.approx(3.65, abs=1e-9)
    assert longest_lease(1.2, 2.0, 2.0, 0.1, 0.1, 0.1) == pytest.approx(-0.1, abs=1e-9)
    # 8 m of budget instead of 10 lost to a speed of 4 instead of 2
    assert longest_lease(10.0, 6.0, 2.0, 0.0, 0.5, 0.5) == pytest.approx(0.0, abs=1e-9)
    assert longest_lease(10.0, 6.1, 2.0, 0.0, 0.5, 0.5) < 0.0


def stop_by_simulation(lease, clearance, speed, braking, delays, acceleration, top, step=1e-4):
    """Clearance left when a machine at full throttle brakes at the end of lease and delays; fine steps."""
    onset = lease + delays
    ahead, now, v = clearance, 0.0, speed
    while now < onset:
        dt = min(step, onset - now)
        faster = min(max(top, v), v + acceleration * dt)
        ahead -= 0.5 * (v + faster) * dt
        now, v = now + dt, faster
    while v > 0.0:
        dt = min(step, v / braking)
        ahead -= v * dt - 0.5 * braking * dt * dt
        v = v - braking * dt if dt == step else 0.0
    return ahead


@pytest.mark.parametrize("acceleration, top", [(0.0, np.inf), (1.5, np.inf), (1.5, 2.0), (1.5, 0.5)])
@pytest.mark.parametrize("seed", range(4))
def test_a_lease_of_the_formula_stops_at_the_margin_and_five_percent_more_hits(acceleration, top, seed):
    rng = np.random.default_rng(seed)
    speed, braking, delays = rng.uniform(0.3, 2.0), rng.uniform(1.0, 4.0), rng.uniform(0.0, 0.2)
    reserve = rng.uniform(0.5, 2.0)
    clearance = (speed + 3.0) ** 2 / (2.0 * braking) + reserve
    rest = (speed, braking, delays)
    lease = float(longest_lease(clearance, *rest, 0.05, 0.1, acceleration, top))
    assert lease > 0.0
    left = stop_by_simulation(lease, clearance, *rest, acceleration, top)
    assert left == pytest.approx(0.15, abs=1e-6)  # the localisation bound and the margin are still there
    bare = float(longest_lease(clearance, *rest, acceleration=acceleration, top_speed=top))
    assert stop_by_simulation(bare, clearance, *rest, acceleration, top) > -1e-6
    assert stop_by_simulation(1.05 * bare, clearance, *rest, acceleration, top) < -1e-3


def test_standing_and_receding():
    with np.errstate(all="raise"):
        assert longest_lease(1.0, 0.0, 1.0, 0.1) == np.inf
        assert longest_lease(1.0, -2.0, 1.0, 0.1) == np.inf
        assert longest_lease(0.3, 0.0, 1.0, 0.1, localisation=0.1, margin=0.2) == -np.inf
        assert longest_lease(-0.1, -2.0, 1.0, 0.1) == -np.inf
        assert longest_lease(1.0, 0.0, 1.0, 0.1, acceleration=1.0, top_speed=0.0) == np.inf
    # from rest: tau^2 / 2 + tau^2 / 2 = 1
    assert longest_lease(1.0, 0.0, 1.0, 0.1, acceleration=1.0) == pytest.approx(0.9, abs=1e-12)
    # receding by 2 m/s it is back after 4 s, at 2 m/s again
    assert longest_lease(2.0, -2.0, 1.0, 0.0, acceleration=1.0) == pytest.approx(4.0, abs=1e-12)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", range(7))
def test_what_is_not_finite_revokes(bad, place):
    inputs = [1.0, 0.5, 1.0, 0.1, 0.0, 0.0, 0.2]
    inputs[place] = bad
    assert longest_lease(*inputs) == -np.inf
    batch = longest_lease([1.0, bad if place == 0 else np.nan], 0.5, 1.0, 0.1)
    assert batch[0] > 0.0 and batch[1] == -np.inf  # one bad reading does not take the others along


@pytest.mark.parametrize("name", ["delays_s", "localisation", "margin", "acceleration", "top_speed"])
def test_what_would_lengthen_a_lease_by_mistake_revokes(name):
    assert longest_lease(1.0, 1.0, 1.0, **{"delays_s": 0.1, name: -0.1}) == -np.inf


@given(*[st.floats(allow_nan=True, allow_infinity=True)] * 3, *[st.floats(min_value=0.0)] * 5)
def test_never_nan_and_never_long_by_overflow(d, v, b, delays, loc, gap, a, top):
    lease = float(longest_lease(d, v, b, delays, loc, gap, a, top))
    assert not np.isnan(lease)
    if lease == np.inf:
        assert v <= 0.0 or used(1e300, v, b, delays, loc, gap, a, None if np.isinf(top) else top) <= Fraction(
            d
        )


@given(st.floats(0.5, 20), st.floats(0, 5), POSITIVE, SMALL, st.floats(0, 3), st.floats(0.01, 1))
def test_more_of_anything_bad_shortens_the_lease(d, v, b, delays, a, more):
    lease = longest_lease(d, v, b, delays, acceleration=a)
    assert longest_lease(d + more, v, b, delays, acceleration=a) >= lease
    for shorter in (
        longest_lease(d, v + more, b, delays, acceleration=a),
        longest_lease(d, v, b, delays + more, acceleration=a),
        longest_lease(d, v, b, delays, more, acceleration=a),
        longest_lease(d, v, b, delays, margin=more, acceleration=a),
        longest_lease(d, v, b, delays, acceleration=a + more),
    ):
        assert shorter <= lease + 1e-9 * abs(lease) or lease <= 0.0
