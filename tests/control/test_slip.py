"""The slip ratio, and the window of a slip limit."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.control.vehicle.slip import slip_ratio, slip_window
from safe_wrappers.errors import ConfigurationError

speeds = st.floats(-30.0, 30.0)
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


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: slip_ratio(1.0, 1.0, 0.0), "regularization"),
        (lambda: slip_ratio(math.nan, 1.0, 0.5), "wheel_speed must be finite"),
        (lambda: slip_window(1.0, 1.0, 0.5), r"\(0, 1\)"),
        (lambda: slip_window(1.0, 0.0, 0.5), "max_slip"),
        (lambda: slip_window(1.0, "much", 0.5), "max_slip"),
    ],
)
def test_bad_numbers_are_refused(call, says):
    with pytest.raises(ConfigurationError, match=says):
        call()
