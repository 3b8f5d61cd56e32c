"""Joint ranges kept until the end of a step, against parabolas looked at everywhere."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from safe_wrappers.control.whole_body import largest_acceleration, predicted_position_rows


def top(speed, acceleration, horizon):
    """How far a parabola comes, its top looked for on a fine grid and refined by nothing: an oracle.

    The sharpest one here reaches 1 mm at 5 m/s; over 0.5 s the grid misses 0.1 % of it.
    """
    t = np.linspace(0.0, horizon, 20_001)
    return float((speed * t + 0.5 * acceleration * t * t).max())


@given(st.floats(1e-3, 3.0), st.floats(-5.0, 5.0), st.floats(0.005, 0.5))
@example(0.0010701, 5.0, 0.5)  # a top that is 0.4 ms wide
def test_the_largest_acceleration_comes_up_to_the_limit_and_no_farther(distance, speed, horizon):
    a = float(largest_acceleration(distance, speed, horizon))
    scale = distance + abs(speed) * horizon
    assert top(speed, a, horizon) == pytest.approx(distance, abs=1e-4 * scale)
    assert top(speed, a + 0.02 * (abs(a) + 1.0), horizon) > distance


def test_the_end_alone_would_let_it_through():
    # Fast, close, strong enough a brake that it is back at the end: in between it was beyond.
    distance, speed, horizon = 0.01, 1.0, 0.1
    end = 2.0 * (distance - horizon * speed) / horizon**2
    assert top(speed, end, horizon) > 2.0 * distance
    assert largest_acceleration(distance, speed, horizon) == pytest.approx(-(speed**2) / (2 * distance))


def test_rows_name_the_right_joints_and_leave_unlimited_ones_out():
    rows, limits = predicted_position_rows(
        *(np.array([6, 8, 7]), np.array([0.1, 0.0, -0.2]), np.array([1.0, 0.0, -1.0])),
        *(np.array([-1.0, -np.inf, -0.5]), np.array([0.5, np.inf, np.inf]), 0.1, 9),
    )
    assert rows.tolist() == [np.eye(9)[6].tolist(), (-np.eye(9)[6]).tolist(), (-np.eye(9)[7]).tolist()]
    expected = [
        largest_acceleration(0.4, 1.0, 0.1),
        largest_acceleration(1.1, -1.0, 0.1),
        largest_acceleration(0.3, 1.0, 0.1),
    ]
    assert limits == pytest.approx(np.array(expected))
    nothing, none = predicted_position_rows(np.zeros(0, int), *np.zeros((4, 0)), 0.1, 4)
    assert nothing.shape == (0, 4) and none.shape == (0,)
