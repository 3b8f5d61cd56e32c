"""Leases with a stop of limited jerk: against ruckig, and machines that stop at the bound or hit."""

import math

import numpy as np
import pytest
import ruckig
from hypothesis import assume, example, given
from hypothesis import strategies as st

from safe_wrappers.control.watchdog.leases import jerk_limited_stop, longest_lease, round_trip_ceiling
from safe_wrappers.errors import ConfigurationError

speeds, accelerations = st.floats(0.01, 5.0), st.one_of(st.just(0.0), st.floats(0.05, 10.0))
brakes, jerks = st.floats(0.2, 20.0), st.floats(0.5, 500.0)


def stop_of_ruckig(v, a, b, jerk):
    """Way and time of ruckig's shortest stop, by its velocity interface."""
    request = ruckig.InputParameter(1)
    request.control_interface = ruckig.ControlInterface.Velocity
    request.current_position, request.current_velocity, request.current_acceleration = [0.0], [v], [a]
    request.target_velocity, request.target_acceleration = [0.0], [0.0]
    request.max_acceleration, request.min_acceleration, request.max_jerk = [max(a, b)], [-b], [jerk]
    trajectory = ruckig.Trajectory(1)
    ruckig.Ruckig(1).calculate(request, trajectory)
    return trajectory.at_time(trajectory.duration)[0][0], trajectory.duration


@given(speeds, accelerations, brakes, jerks)
@example(1.0, 0.0, 1.0, 1.0)  # the full braking is just reached
@example(0.01, 10.0, 20.0, 0.5)
def test_the_way_of_a_stop_is_ruckigs(v, a, b, jerk):
    assert jerk_limited_stop(v, a, b, jerk) == pytest.approx(stop_of_ruckig(v, a, b, jerk)[0], rel=1e-9)


@given(speeds, brakes)
def test_without_a_limit_on_the_jerk_it_is_the_stopping_distance(v, b):
    assert jerk_limited_stop(v, 3.0, b, np.inf) == pytest.approx(v**2 / (2.0 * b), rel=1e-12)
    assert jerk_limited_stop(v, 0.0, b, 1e9) == pytest.approx(v**2 / (2.0 * b), rel=1e-3)


def brakes_at_once(lease, clearance, speed, acceleration, top, braking, jerk, delays, step=2e-5):
    """What is left when a machine at full throttle brakes at the end of lease and delays, in fine steps.

    Its throttle and its brakes are a command that changes by the jerk; its speed stops at the top speed.
    """
    ahead, now, v, a = clearance, 0.0, speed, acceleration
    onset, release = lease + delays, False
    while now < onset or v > 0.0 or (a > 0.0 and now < onset + 1e3):
        dt = min(step, onset - now) if now < onset else step
        if now >= onset:
            # The braking is taken back as soon as that will just do.
            release = release or (a < 0.0 and v <= a * a / (2.0 * jerk))
            a = min(a + jerk * dt, 0.0) if release else max(a - jerk * dt, -braking)
            if release and a == 0.0:
                break
        faster = max(min(max(top, speed), v + a * dt), 0.0 if now >= onset and a < 0.0 else -math.inf)
        ahead -= 0.5 * (v + faster) * dt
        now, v = now + dt, faster
    return ahead


MACHINES = [
    (0.0, np.inf, 3.0, 20.0),
    (1.5, np.inf, 3.0, 20.0),
    (1.5, 2.0, 3.0, 8.0),
    (1.5, 2.05, 1.0, 2.0),
    (4.0, 1.2, 6.0, 5.0),
]


@pytest.mark.parametrize(("acceleration", "top", "braking", "jerk"), MACHINES)
@pytest.mark.parametrize("speed", [0.4, 1.1])
def test_a_lease_stops_at_the_margin_and_five_percent_more_hits(acceleration, top, braking, jerk, speed):
    bounds = {"acceleration": acceleration, "top_speed": top, "jerk": jerk}
    clearance, delays = 4.0, 0.1
    lease = float(longest_lease(clearance, speed, braking, delays, 0.05, 0.1, **bounds))
    assert lease > 0.0
    machine = (speed, acceleration, top, braking, jerk, delays)
    assert brakes_at_once(lease, clearance, *machine) == pytest.approx(0.15, abs=2e-3)
    bare = float(longest_lease(clearance, speed, braking, delays, **bounds))
    assert abs(brakes_at_once(bare, clearance, *machine)) < 2e-3
    assert brakes_at_once(1.05 * bare, clearance, *machine) < -0.01
    # What forgets the jerk is too long, and hits.
    bounds["jerk"] = np.inf
    forgets = float(longest_lease(clearance, speed, braking, delays, **bounds))
    assert forgets > bare and brakes_at_once(forgets, clearance, *machine) < -0.01


@given(st.floats(0.1, 20.0), speeds, accelerations, brakes, jerks, st.floats(0.0, 0.5))
def test_from_every_moment_of_a_lease_ruckigs_stop_fits(clearance, v, a, b, jerk, delays):
    lease = float(longest_lease(clearance, v, b, delays, acceleration=a, jerk=jerk))
    assume(lease > 0.0)
    for share in (0.0, 0.3, 0.7, 0.95, 1.0):
        tau = share * (lease + delays)
        way = v * tau + 0.5 * a * tau**2 + stop_of_ruckig(v + a * tau, a, b, jerk)[0]
        assert way <= clearance * (1.0 + 1e-9)
    assert way >= clearance * (1.0 - 1e-7)  # and not sooner than it has to be
    tau = 1.05 * lease + delays
    assert v * tau + 0.5 * a * tau**2 + stop_of_ruckig(v + a * tau, a, b, jerk)[0] > clearance


@given(st.floats(0.5, 20.0), st.floats(-3.0, 3.0), accelerations, brakes, jerks, st.floats(0.1, 4.0))
def test_less_jerk_or_a_faster_top_shortens_the_lease(clearance, v, a, b, jerk, top):
    def lease(j, highest):
        return float(longest_lease(clearance, v, b, 0.05, acceleration=a, jerk=j, top_speed=highest))

    sharp = lease(1e12, top)
    assert (
        lease(0.5 * jerk, top) <= lease(jerk, top) <= (sharp + 1e-6 * (1.0 + sharp) if sharp > 0.0 else 0.0)
    )
    assert lease(jerk, 2.0 * top) <= lease(jerk, top) + 1e-9
    exact = float(longest_lease(clearance, v, b, 0.05, acceleration=a, top_speed=top))
    if exact > 0.0 and math.isfinite(exact):
        assert sharp == pytest.approx(exact, rel=1e-3, abs=1e-3)


def test_standing_receding_and_turning_round():
    rest = {"acceleration": 0.0, "jerk": 5.0}
    assert longest_lease(1.0, 0.0, 1.0, 0.1, **rest) == np.inf == longest_lease(1.0, -2.0, 1.0, 0.1, **rest)
    assert longest_lease(-0.1, -2.0, 1.0, 0.1, **rest) == -np.inf
    assert jerk_limited_stop(-2.0, 1.0, 1.0, 5.0) == 0.0
    # Receding by 2 m/s it is back after 4 s at 2 m/s; from there as from the start of that.
    bounds = {"acceleration": 1.0, "jerk": 5.0}
    back = longest_lease(3.0, -2.0, 2.0, 0.0, **bounds)
    assert back == pytest.approx(4.0 + longest_lease(3.0, 2.0, 2.0, 0.0, **bounds))
    # Too late for any stop.
    assert (
        longest_lease(0.3, 1.0, 1.0, 0.0, jerk=5.0) == -np.inf < longest_lease(0.6, 1.0, 1.0, 0.0, jerk=1e6)
    )


def test_the_ceiling_of_a_round_trip_counts_it_too():
    late = {"video_s": 0.1, "human_s": 0.2, "act_s": 0.05}
    ceiling = round_trip_ceiling(2.0, 1.0, 2.0, **late, jerk=4.0)
    assert ceiling == pytest.approx((2.0 - stop_of_ruckig(1.0, 0.0, 2.0, 4.0)[0]) / 1.0 - 0.35)


def test_batches_unknown_numbers_and_refusals():
    together = longest_lease([1.0, 2.0, np.nan], [0.5], 1.0, 0.1, jerk=[[3.0], [np.inf]])
    assert together.shape == (2, 3) and (together[:, 2] == -np.inf).all()
    assert together[1, 1] == longest_lease(2.0, 0.5, 1.0, 0.1) and together[0, 0] == longest_lease(
        1.0, 0.5, 1.0, 0.1, jerk=3.0
    )
    assert (
        longest_lease(1.0, 0.5, 1.0, 0.1, jerk=np.nan)
        == -np.inf
        == longest_lease(1.0, 0.5, 1.0, 0.1, jerk=0.0)
    )
    with pytest.raises(ConfigurationError, match="jerk must not be negative"):
        longest_lease(1.0, 0.5, 1.0, 0.1, jerk=-1.0)


@given(*[st.floats(allow_nan=True, allow_infinity=True)] * 3, *[st.floats(min_value=0.0)] * 6)
def test_never_nan_whatever_comes(d, v, b, delays, loc, gap, a, top, jerk):
    assert not np.isnan(longest_lease(d, v, b, delays, loc, gap, a, top, jerk))
