"""Slip ratios in both forms, the window of a slip limit, the wheel's equation and the spin-out test."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from safe_wrappers.appendix.vehicle.slip import (
    normalized_slip,
    piecewise_slip_ratio,
    spins_out,
    wheel_acceleration,
)
from safe_wrappers.appendix.vehicle.traction_curves import MAGIC_FORMULA
from safe_wrappers.control.vehicle.slip import slip_ratio, slip_window
from safe_wrappers.errors import ConfigurationError

speeds = st.floats(-30.0, 30.0)
moving = st.floats(0.05, 30.0)
slips = st.floats(0.01, 0.9)
floors = st.floats(0.01, 2.0)


@pytest.mark.parametrize(
    ("wheel", "ground", "slip"),
    [
        (2.0, 2.0, 0.0),  # rolling
        (3.0, 0.0, 1.0),  # spins on the spot
        (0.0, 3.0, -1.0),  # locked
        (2.0, 1.0, 0.5),  # drives
        (1.0, 2.0, -0.5),  # brakes
        (-2.0, -1.0, -0.5),  # drives in reverse: pushes backwards
        (-1.0, -2.0, 0.5),  # brakes in reverse: pushes forwards
        (1.0, -1.0, 2.0),  # turns against the motion
        (0.0, 0.0, 0.0),  # at rest
    ],
)
def test_named_cases(wheel, ground, slip):
    assert slip_ratio(wheel, ground, 1e-3) == slip


@given(moving, moving, st.sampled_from([-1.0, 1.0]))
def test_the_two_forms_are_one_through_their_map(wheel, ground, direction):
    wheel, ground = direction * wheel, direction * ground
    piecewise = piecewise_slip_ratio(wheel, ground)
    assert normalized_slip(piecewise) == pytest.approx(slip_ratio(wheel, ground, 1e-9), abs=1e-12)


@given(moving, st.floats(-1e-4, 1e-4))
def test_the_two_forms_agree_to_first_order(ground, small):
    wheel = ground * (1.0 + small)
    piecewise, normalized = piecewise_slip_ratio(wheel, ground), slip_ratio(wheel, ground, 1e-9)
    assert abs(piecewise - normalized) <= 1.01 * small**2 + 1e-15


def test_the_two_forms_are_not_one_measure():
    assert piecewise_slip_ratio(3.0, 1.0) == 2.0
    assert slip_ratio(3.0, 1.0, 1e-9) == pytest.approx(2.0 / 3.0)


@pytest.mark.parametrize(("wheel", "ground"), [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, -1.0)])
def test_the_piecewise_form_says_where_it_does_not_hold(wheel, ground):
    assert math.isnan(piecewise_slip_ratio(wheel, ground))


@given(speeds, speeds, floors)
def test_reversing_mirrors(wheel, ground, floor):
    assert slip_ratio(-wheel, -ground, floor) == -slip_ratio(wheel, ground, floor)


@given(st.floats(0.0, 30.0), st.floats(0.0, 30.0), floors)
def test_bounded_by_one_while_both_go_the_same_way(wheel, ground, floor):
    assert abs(slip_ratio(wheel, ground, floor)) <= 1.0


@given(speeds, slips, floors)
def test_the_window_ends_where_the_slip_is_reached(ground, limit, floor):
    low, high = slip_window(ground, limit, floor)
    assert slip_ratio(low, ground, floor) == pytest.approx(-limit, abs=1e-9)
    assert slip_ratio(high, ground, floor) == pytest.approx(limit, abs=1e-9)


@given(speeds, speeds, slips, floors)
def test_the_window_is_the_limit(wheel, ground, limit, floor):
    low, high = slip_window(ground, limit, floor)
    slip = float(slip_ratio(wheel, ground, floor))
    if abs(abs(slip) - limit) > 1e-9:
        assert (low < wheel < high) == (abs(slip) < limit)


def test_leading_axes_broadcast():
    low, high = slip_window(np.linspace(-3.0, 3.0, 12).reshape(3, 4), 0.15, 0.5)
    assert low.shape == high.shape == (3, 4)
    assert slip_ratio(np.zeros((3, 1)), np.ones(4), 0.5).shape == (3, 4)


def test_wheel_acceleration_is_the_wheels_equation():
    assert wheel_acceleration(3.0, 20.0, 0.1, 0.05, damping=0.2, wheel_rate=2.0) == pytest.approx(12.0)


def test_more_torque_than_the_peak_carries_spins_the_wheel_out():
    """A quarter car driven for 3 s a little below and a little above what the peak carries."""
    curve, load, mass, radius, inertia = MAGIC_FORMULA["wet"], 40.0, 4.0, 0.1, 0.05

    def motion(_, state, force):
        rate, speed = state
        traction = curve.at(float(slip_ratio(radius * rate, speed, 0.5))) * load
        return [float(wheel_acceleration(radius * force, traction, radius, inertia)), traction / mass]

    for share in (0.93, 1.35):
        # The wheel's own inertia takes I a / r^2 of the drive force before the ground carries any of it.
        force = share * 0.7 * load * (1.0 + inertia / (mass * radius**2))
        end = solve_ivp(motion, (0.0, 3.0), [0.0, 0.0], args=(force,), rtol=1e-7, atol=1e-9).y[:, -1]
        slip = float(slip_ratio(radius * end[0], end[1], 0.5))
        carried = force - inertia / radius**2 * share * 0.7 * load / mass
        assert bool(spins_out(carried, 0.7, load)) == (share > 1.0) == (slip > 0.5)


def test_direction_alone_says_nothing_of_spin_out():
    assert not spins_out(27.9, 0.7, 40.0)
    assert spins_out(28.1, 0.7, 40.0)
    assert spins_out(-28.1, 0.7, 40.0)
    assert spins_out(0.1, 0.7, 0.0)  # in the air


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: slip_ratio(1.0, 1.0, 0.0), "regularization"),
        (lambda: slip_ratio(math.nan, 1.0, 0.5), "wheel_speed must be finite"),
        (lambda: slip_window(1.0, 1.0, 0.5), r"\(0, 1\)"),
        (lambda: slip_window(1.0, 0.0, 0.5), "max_slip"),
        (lambda: slip_window(1.0, "much", 0.5), "max_slip"),
        (lambda: wheel_acceleration(1.0, 1.0, 0.0, 1.0), "radius"),
        (lambda: wheel_acceleration(1.0, 1.0, 0.1, -1.0), "inertia"),
        (lambda: spins_out(1.0, 0.0, 1.0), "peak_friction must be > 0"),
        (lambda: spins_out(1.0, 1.0, -1.0), "load"),
    ],
)
def test_bad_numbers_are_refused(call, says):
    with pytest.raises(ConfigurationError, match=says):
        call()
