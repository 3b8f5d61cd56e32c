"""Leases in exact fractions (machines that stop: LeaseExpiry's); reach by ruckig and bang-bang motion."""

from fractions import Fraction
from unittest import mock

import numpy as np
import pytest
import ruckig
from hypothesis import assume, example, given
from hypothesis import strategies as st

from safe_wrappers.control import watchdog
from safe_wrappers.control.watchdog import admits, furthest, longest_lease, transit_time

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


@given(*[st.floats(allow_nan=True, allow_infinity=True)] * 3, *[st.floats(min_value=0.0)] * 5)
def test_never_nan_and_never_long_by_overflow(d, v, b, delays, loc, gap, a, top):
    lease = float(longest_lease(d, v, b, delays, loc, gap, a, top))
    assert not np.isnan(lease)
    if lease == np.inf and v > 0.0:
        assert used(1e300, v, b, delays, loc, gap, a, None if np.isinf(top) else top) <= Fraction(d)


@pytest.mark.parametrize(
    ("arguments", "lease"),
    [
        ((10.0, 2.0, 2.0, 0.6, 0.3, 0.2), 3.65),  # (10 - 0.3 - 0.2 - 4 / 4) / 2 - 0.6
        ((1.0, -2.0, 1.0, 0.1), np.inf),  # receding
        ((0.3, 0.0, 1.0, 0.1, 0.1, 0.2), -np.inf),  # there is no room left
        ((1.0, 0.0, 1.0, 0.1, 0.0, 0.0, 1.0, 0.0), np.inf),  # nothing speeds it up
        ((2.0, -2.0, 1.0, 0.0, 0.0, 0.0, 1.0), 4.0),  # it is back after 4 s, at 2 m/s again
    ],
)
def test_by_hand(arguments, lease):
    with np.errstate(all="raise"):
        assert longest_lease(*arguments) == pytest.approx(lease, abs=1e-9)


@pytest.mark.parametrize(
    ("place", "bad"),
    [(place, bad) for place in range(7) for bad in (np.nan, np.inf, -np.inf)]
    + [(place, -0.1) for place in range(2, 8)],
)
def test_what_is_not_finite_or_would_lengthen_a_lease_by_mistake_revokes(place, bad):
    given_ = [1.0, 0.5, 1.0, 0.1, 0.0, 0.0, 0.2, 5.0]
    several = [np.array([one, bad if k == place else one]) for k, one in enumerate(given_)]
    found = longest_lease(*several)
    assert found[0] > 0.0 and found[1] == -np.inf  # one bad reading does not take the others along


# Reach ------------------------------------------------------------------------------------------------------------


@given(
    st.floats(1e-3, 5), st.floats(-3, 3), st.floats(0.1, 10.0), st.one_of(st.floats(0.1, 10.0), st.just(1e3))
)
def test_the_bound_is_bang_bang_and_rounding_never_refuses(time, v, acceleration, speed):
    found = furthest(time, v, speed, acceleration)
    t, a = Fraction(time), Fraction(acceleration)
    for way, v0 in ((-found[0], Fraction(-v)), (found[1], Fraction(v))):
        top = max(Fraction(speed), v0)
        until = min(t, (top - v0) / a)
        exact = max(Fraction(0), v0 * until + a * until**2 / 2 + top * (t - until))
        assert exact <= Fraction(float(way)) <= exact * (1 + Fraction(1e-9)) + Fraction(1e-12)


@given(st.integers(0, 2**31))
def test_no_motion_of_ruckig_is_refused_however_it_starts(seed):
    # Starts over the speed limit too: ruckig leads them back inside.
    rng = np.random.default_rng(seed)
    acceleration, speed, jerk = rng.uniform(0.3, 3.0, 3) * [1, 1, 3]
    position, velocity, accelerated = rng.normal(size=3) * [1.0, 2.0 * speed, 0.5 * acceleration]
    accelerated = np.clip(accelerated, -acceleration, acceleration)
    request, trajectory = ruckig.InputParameter(1), ruckig.Trajectory(1)
    request.current_position, request.current_velocity = [position], [velocity]
    request.current_acceleration = [accelerated]
    request.target_position = [rng.normal() * 3]
    request.max_acceleration, request.max_velocity, request.max_jerk = [acceleration], [speed], [jerk]
    ruckig.Ruckig(1).calculate(request, trajectory)
    times = np.linspace(0.0, trajectory.duration, 200)
    xs = np.array([trajectory.at_time(t)[0][0] for t in times])
    if abs(velocity + accelerated * abs(accelerated) / (2 * jerk)) <= speed:
        assert admits(xs, position, velocity, times, speed, acceleration).all()


@pytest.mark.parametrize(
    "way, time", [(10.0, 10 / 2 + 2 / 1 + 1 / 0.5), (0.1, 4 * (0.1 / (2 * 0.5)) ** (1 / 3))], ids=["7", "4"]
)
def test_phases_of_jerk_by_hand(way, time):
    assert transit_time(way, 0.0, 0.0, 2.0, 1.0, max_jerk=0.5) == pytest.approx(time, rel=1e-9)


@given(st.floats(0.1, 3.0), st.floats(0.1, 3.0), st.floats(0.01, 9.0), st.floats(-2.0, 2.0))
def test_the_time_to_rest_is_the_closed_form_of_the_slowest_axis(speed, acceleration, way, start):
    def alone(way, v, a):
        return way / v + v / a if way > v * v / a else 2.0 * np.sqrt(way / a)

    together = transit_time([start + way / 2, start - way], start, 0.0, [0.7, speed], [0.4, acceleration])
    slowest = max(alone(way / 2, 0.7, 0.4), alone(way, speed, acceleration))
    assert together == pytest.approx(slowest, rel=1e-6)
    # Already at full speed where one from rest would have reached it, it takes as long less the speeding up.
    moving = transit_time(start + way, start - 0.5 * speed**2 / acceleration, speed, speed, acceleration)
    assert moving == pytest.approx(way / speed + speed / acceleration, rel=1e-6)


def test_a_start_that_is_too_fast_is_braked_first():
    # 4 s down to 1 m/s, over 12 m; 0.5 m more to rest is 11.5 m too far: 1 + 11.5 s back, and 1 s of it to speed up.
    assert transit_time(1.0, 0.0, 5.0, 1.0, 1.0) == pytest.approx(17.5)


@pytest.mark.parametrize("name", ["goal", "position", "velocity"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_refused(name, bad):
    motion, limits = {"goal": 0.1, "position": 0.0, "velocity": 0.1}, {"max_speed": 1, "max_acceleration": 1}
    assert admits(**motion, **limits, duration=1.0) and transit_time(**motion, **limits) < 1.0
    motion[name] = np.array([bad, motion[name]])
    assert admits(**motion, **limits, duration=1.0).tolist() == [False, True]
    assert transit_time(**motion, **limits) == np.inf


def test_what_ruckig_refuses_is_not_reached(monkeypatch):
    broken = mock.Mock(
        **{"return_value.calculate.side_effect": ruckig.RuckigError("error in step 1, dof: 0")}
    )
    monkeypatch.setattr(watchdog.ruckig, "Ruckig", broken)
    assert transit_time(1.0, 0.0, 0.0, np.inf, 1.0) == np.inf and broken.called
