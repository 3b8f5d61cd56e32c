"""Reachability: against ruckig, bang-bang motion, linear programs over the jerk, and random admissible motions."""

from fractions import Fraction

import numpy as np
import pytest
import ruckig
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from safe_wrappers.control.watchdog import reachability
from safe_wrappers.control.watchdog.reachability import MotionLimits, admits, furthest, jerk_limited_time
from safe_wrappers.errors import ConfigurationError

POSITIVE = st.floats(0.1, 10.0)
SHARE = st.floats(-1.0, 1.0)


def most(time, v0, a0, a_max, v_max, jerk, count=160, sign=1.0):
    """The largest displacement at the end of the time, by a linear program over piecewise constant jerk."""
    h = time / count
    n = count
    ones = np.tril(np.ones((n, n)))  # knot k after intervals 0 .. k
    acc = h * ones
    vel = h * np.tril(np.ones((n, n)), -1) @ acc + 0.5 * h * h * ones
    acc0, vel0 = np.full(n, a0), v0 + a0 * h * np.arange(1, n + 1)
    before_v = np.vstack([np.zeros(n), vel[:-1]])
    before_a = np.vstack([np.zeros(n), acc[:-1]])
    pos = (h * before_v + 0.5 * h * h * before_a + np.eye(n) * h**3 / 6).sum(axis=0)
    pos0 = v0 * time + 0.5 * a0 * time**2
    upper = np.concatenate([a_max - acc0, a_max + acc0, v_max - vel0, v_max + vel0])
    done = linprog(
        -sign * pos,
        A_ub=np.vstack([acc, -acc, vel, -vel]),
        b_ub=upper + 1e-12,
        bounds=(-jerk, jerk),
        method="highs",
    )
    return pos0 + pos @ done.x if done.status == 0 else None


# With limited jerk.


@pytest.mark.parametrize(
    "distance, time",
    [(10.0, 10 / 2 + 2 / 1 + 1 / 0.5), (0.1, 4 * (0.1 / (2 * 0.5)) ** (1 / 3))],
)
def test_seven_and_four_phases_by_hand(distance, time):
    limits = MotionLimits(max_acceleration=1.0, max_speed=2.0, max_jerk=0.5)
    assert float(jerk_limited_time((0, 0, 0), (distance, 0, 0), limits)) == pytest.approx(time, rel=1e-9)


def inside(state, acceleration, speed, jerk):
    """Scaled so that neither its past nor its future must leave the limits, by more than ruckig's rounding."""
    p, v, a = state
    a *= min(acceleration, np.sqrt(jerk * speed))
    v *= (1.0 - 1e-6) * speed - 0.5 * a * a / jerk
    return p, v, a


@pytest.mark.parametrize(
    "end",
    [(1, 1.01, 0), (1, 0, 2.01), (1, 0.9, -2.0), (1, -0.9, 2.0), (np.nan, 0, 0), (1, np.inf, 0)],
)
def test_ends_that_no_motion_inside_the_limits_has(end):
    assert jerk_limited_time((0, 0, 0), end, MotionLimits(2.0, 1.0, 5.0)) == np.inf


# The bound with a free end.


@given(st.floats(0, 5), st.floats(-3, 3), POSITIVE, POSITIVE)
def test_without_a_jerk_limit_the_bound_is_bang_bang(time, v, acceleration, speed):
    lowest, highest = (float(x) for x in furthest(time, v, 0.0, speed, acceleration))

    def up(v0):
        top = max(speed, v0)
        until = min(time, (top - v0) / acceleration)
        return max(0.0, v0 * until + acceleration * until**2 / 2 + top * (time - until))

    assert highest == pytest.approx(up(v), rel=1e-9, abs=1e-12)
    assert -lowest == pytest.approx(up(-v), rel=1e-9, abs=1e-12)


@settings(max_examples=15)
@given(st.floats(0.2, 3.0), SHARE, SHARE, st.floats(0.5, 3), st.floats(0.5, 3), st.floats(0.5, 6))
def test_no_linear_program_gets_beyond_the_bound_and_without_a_speed_limit_it_gets_there(
    time, v, a, acceleration, speed, jerk
):
    _, v, a = inside((0, v, a), acceleration, speed, jerk)
    for sign, limit in ((1.0, speed), (-1.0, speed), (1.0, 100.0), (-1.0, 100.0)):
        lowest, highest = (float(x) for x in furthest(time, v, a, limit, acceleration, jerk))
        bound = highest if sign > 0 else -lowest
        optimum = sign * most(time, v, a, acceleration, limit, jerk, sign=sign)
        assert optimum <= bound + 2e-4 * jerk * time**3
        if limit == 100.0 and sign * v >= 0.0 and sign * a >= 0.0:
            assert optimum == pytest.approx(bound, rel=0.02, abs=0.01)


@given(st.floats(0.1, 4.0), st.floats(0, 3), st.floats(0, 1), st.floats(0.1, 1))
def test_rounding_never_refuses(time, v, a, jerk):
    # Limits too far to be met: the way is v t + a t^2 / 2 + j t^3 / 6, here in exact fractions.
    t, exact_v, exact_a, j = (Fraction(x) for x in (time, v, a, jerk))
    way = exact_v * t + exact_a * t**2 / 2 + j * t**3 / 6
    _, highest = furthest(time, v, a, 1e3, 1e3, jerk)
    assert Fraction(float(highest)) >= way
    assert -Fraction(float(furthest(time, -v, -a, 1e3, 1e3, jerk)[0])) >= way


def random_motion(rng, acceleration, speed, jerk, start, steps, dt):
    """Positions of an admissible motion: random jerk, cut where it would leave the limits now or later."""
    x, v, a = start
    xs, wanted = [x], 0.0
    for _ in range(steps):
        if rng.random() < 0.1:
            wanted = rng.choice([-jerk, 0.0, jerk, rng.uniform(-jerk, jerk)])
        for j in (wanted, 0.0, -np.sign(a) * min(jerk, abs(a) / dt), -np.sign(a) * jerk):
            a1, v1 = a + j * dt, v + a * dt + 0.5 * j * dt * dt
            if abs(a1) <= acceleration and abs(v1 + a1 * abs(a1) / (2 * jerk)) <= speed and abs(v1) <= speed:
                break
        x, v, a = x + v * dt + 0.5 * a * dt**2 + j * dt**3 / 6, v1, a1
        xs.append(x)
    return np.array(xs), abs(v) <= speed and abs(a) <= acceleration


@pytest.mark.parametrize("seed", range(40))
def test_no_admissible_motion_is_refused(seed):
    rng = np.random.default_rng(seed)
    acceleration, speed, jerk = rng.uniform(0.3, 3.0, 3) * [1, 1, 3]
    start = inside((rng.normal(), *rng.uniform(-1, 1, 2)), acceleration, speed, jerk)
    xs, kept = random_motion(rng, acceleration, speed, jerk, start, 400, 0.005)
    assert kept
    times = 0.005 * np.arange(len(xs))
    assert admits(xs, start[0], start[1], times, speed, acceleration, jerk, start[2]).all()
    assert admits(xs, start[0], start[1], times, speed, acceleration).all()
    assert admits(xs, start[0], start[1], times, speed, acceleration, jerk, acceleration=None).all()


@pytest.mark.parametrize("seed", range(40))
def test_no_motion_of_ruckig_is_refused_however_it_starts(seed):
    # Starts over every limit too: ruckig leads them back inside.
    rng = np.random.default_rng(seed)
    acceleration, speed, jerk = rng.uniform(0.3, 3.0, 3) * [1, 1, 3]
    request, trajectory = ruckig.InputParameter(1), ruckig.Trajectory(1)
    position, velocity, accelerated = rng.normal(), rng.normal() * 2 * speed, rng.normal() * acceleration
    request.current_position, request.current_velocity = [position], [velocity]
    request.current_acceleration = [accelerated]
    request.target_position = [rng.normal() * 3]
    request.max_acceleration, request.max_velocity, request.max_jerk = [acceleration], [speed], [jerk]
    ruckig.Ruckig(1).calculate(request, trajectory)
    times = np.linspace(0.0, trajectory.duration, 200)
    xs = np.array([trajectory.at_time(t)[0][0] for t in times])
    assert admits(xs, position, velocity, times, speed, acceleration, jerk, accelerated).all()
    if abs(accelerated) <= acceleration and (
        abs(velocity) > speed or abs(velocity + accelerated * abs(accelerated) / (2 * jerk)) <= speed
    ):
        assert admits(xs, position, velocity, times, speed, acceleration, jerk, acceleration=None).all()


def test_an_unmeasured_acceleration_counts_as_the_most_and_no_more():
    # From 1 m/s with 1 m/s^2 at once, whatever the jerk: 1.5 m in a second, then 2 m/s; 3 s until -2 m/s
    for jerk in (0.1, 10.0, np.inf):
        ends = np.array([1.5 + 1.0, -1.5 - 2.0 * 7])
        times = np.array([1.5, 10.0])
        given_ = {"max_speed": 2.0, "max_acceleration": 1.0, "max_jerk": jerk, "acceleration": None}
        assert admits(ends, 0.0, 1.0, times, **given_).all()
        assert not admits(ends + np.array([1e-6, -1e-6]), 0.0, 1.0, times, **given_).any()


@pytest.mark.parametrize("name", ["goal", "position", "velocity", "duration", "acceleration"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_refused(name, bad):
    given_ = {"goal": 0.1, "position": 0.0, "velocity": 0.1, "duration": 1.0, "acceleration": 0.0}
    limits = {"max_speed": 1.0, "max_acceleration": 1.0, "max_jerk": 5.0}
    assert admits(**given_, **limits)
    assert admits(**(given_ | {name: np.array([bad, given_[name]])}), **limits).tolist() == [False, True]


# Mistakes.


@pytest.mark.parametrize("name", ["max_acceleration", "max_speed", "max_jerk"])
@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, [1.0, 0.0]])
def test_limits_must_be_positive(name, bad):
    good = {"max_acceleration": 1.0, "max_speed": 1.0, "max_jerk": 1.0}
    with pytest.raises(ConfigurationError, match=f"{name} must be positive"):
        MotionLimits(**(good | {name: bad}))
    with pytest.raises(ConfigurationError, match=name):
        furthest(1.0, 0.0, 0.0, **(good | {name: bad}))


def test_ruckigs_own_refusals_are_told(monkeypatch):
    class Broken:
        def __init__(self, axes):
            pass

        def calculate(self, request, trajectory):
            raise ruckig.RuckigError("\n[ruckig] error in step 1, dof: 0\ninput: ...")

    monkeypatch.setattr(reachability.ruckig, "Ruckig", Broken)
    with pytest.raises(
        ConfigurationError, match=r"found no profile from .* to .*: \[ruckig\] error in step 1"
    ):
        jerk_limited_time((0, 0, 0), (1, 0, 0), MotionLimits(1.0))
