"""Reachability: against ruckig, and against bang-bang motion."""

from fractions import Fraction

import numpy as np
import pytest
import ruckig
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.control import watchdog
from safe_wrappers.control.watchdog import admits, furthest, jerk_limited_time

POSITIVE = st.floats(0.1, 10.0)


# With limited jerk.


@pytest.mark.parametrize(
    "distance, time",
    [(10.0, 10 / 2 + 2 / 1 + 1 / 0.5), (0.1, 4 * (0.1 / (2 * 0.5)) ** (1 / 3))],
)
def test_seven_and_four_phases_by_hand(distance, time):
    assert jerk_limited_time((0, 0, 0), (distance, 0, 0), 1.0, 2.0, 0.5) == pytest.approx(time, rel=1e-9)


@pytest.mark.parametrize(
    "end",
    [(1, 1.01, 0), (1, 0, 2.01), (1, 0.9, -2.0), (1, -0.9, 2.0), (np.nan, 0, 0), (1, np.inf, 0)],
)
def test_ends_that_no_motion_inside_the_limits_has(end):
    assert jerk_limited_time((0, 0, 0), end, 2.0, 1.0, 5.0) == np.inf


# The bound with a free end.


@given(st.floats(0, 5), st.floats(-3, 3), POSITIVE, POSITIVE)
def test_without_a_jerk_limit_the_bound_is_bang_bang(time, v, acceleration, speed):
    lowest, highest = (float(x) for x in furthest(time, v, speed, acceleration))

    def up(v0):
        top = max(speed, v0)
        until = min(time, (top - v0) / acceleration)
        return max(0.0, v0 * until + acceleration * until**2 / 2 + top * (time - until))

    assert highest == pytest.approx(up(v), rel=1e-9, abs=1e-12)
    assert -lowest == pytest.approx(up(-v), rel=1e-9, abs=1e-12)


@given(st.floats(0.1, 4.0), st.floats(0, 3), st.floats(0, 1))
def test_rounding_never_refuses(time, v, acceleration):
    # A speed limit too far to be met: the way is v t + a t^2 / 2, here in exact fractions.
    t, exact_v, a = (Fraction(x) for x in (time, v, acceleration + 0.1))
    way = exact_v * t + a * t**2 / 2
    assert Fraction(float(furthest(time, v, 1e3, float(a))[1])) >= way
    assert -Fraction(float(furthest(time, -v, 1e3, float(a))[0])) >= way


@pytest.mark.parametrize("seed", range(40))
def test_no_motion_of_ruckig_is_refused_however_it_starts(seed):
    # Starts over the speed limit too: ruckig leads them back inside.
    rng = np.random.default_rng(seed)
    acceleration, speed, jerk = rng.uniform(0.3, 3.0, 3) * [1, 1, 3]
    request, trajectory = ruckig.InputParameter(1), ruckig.Trajectory(1)
    position, velocity, accelerated = (
        rng.normal(),
        rng.normal() * 2 * speed,
        rng.uniform(-1, 1) * acceleration,
    )
    request.current_position, request.current_velocity = [position], [velocity]
    request.current_acceleration = [accelerated]
    request.target_position = [rng.normal() * 3]
    request.max_acceleration, request.max_velocity, request.max_jerk = [acceleration], [speed], [jerk]
    ruckig.Ruckig(1).calculate(request, trajectory)
    times = np.linspace(0.0, trajectory.duration, 200)
    xs = np.array([trajectory.at_time(t)[0][0] for t in times])
    if abs(velocity + accelerated * abs(accelerated) / (2 * jerk)) <= speed:
        assert admits(xs, position, velocity, times, speed, acceleration).all()


@pytest.mark.parametrize("name", ["goal", "position", "velocity"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_refused(name, bad):
    given_ = {"goal": 0.1, "position": 0.0, "velocity": 0.1}
    limits = {"duration": 1.0, "max_speed": 1.0, "max_acceleration": 1.0}
    assert admits(**given_, **limits)
    assert admits(**(given_ | {name: np.array([bad, given_[name]])}), **limits).tolist() == [False, True]


def test_what_ruckig_refuses_is_not_reached(monkeypatch):
    class Broken:
        def __init__(self, axes):
            pass

        def calculate(self, request, trajectory):
            raise ruckig.RuckigError("\n[ruckig] error in step 1, dof: 0\ninput: ...")

    monkeypatch.setattr(watchdog.ruckig, "Ruckig", Broken)
    assert jerk_limited_time((0, 0, 0), (1, 0, 0), 1.0) == np.inf
