import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.envs.goal_robots import LIDAR_BINS, LIDAR_RANGE, pseudo_lidar

coordinate = st.floats(-4, 4, allow_nan=False)
objects = st.lists(st.tuples(coordinate, coordinate, st.integers(0, 2)), max_size=12)


def by_loop(targets):
    """The same readings from the definition: one object, one bin at a time."""
    width = 2 * math.pi / LIDAR_BINS
    readings = [[0.0] * LIDAR_BINS for _ in range(3)]
    for x, y, kind in targets:
        strength = max(0.0, 1 - math.sqrt(x * x + y * y) / LIDAR_RANGE)
        angle = math.atan2(y, x)
        angle = angle + 2 * math.pi if angle < 0 else angle
        ahead = int(angle // width)
        place = angle / width - ahead
        for shift, value in ((0, strength), (1, place * strength), (-1, (1 - place) * strength)):
            spot = (ahead + shift) % LIDAR_BINS
            readings[kind][spot] = max(readings[kind][spot], value)
    return np.array(readings).ravel()


@given(objects)
def test_equals_the_loop(targets):
    relative = np.array([t[:2] for t in targets], dtype=np.float64).reshape(-1, 2)
    kinds = np.array([t[2] for t in targets], dtype=np.intp)
    np.testing.assert_allclose(pseudo_lidar(relative, kinds, 3), by_loop(targets), atol=1e-9)


def test_object_ahead_reads_in_the_first_bin_and_the_last():
    readings = pseudo_lidar(np.array([[1.5, 0.0]]), np.array([0]), 1)
    assert readings[0] == pytest.approx(0.5)
    assert readings[-1] == pytest.approx(0.5)  # on the border: all of it aliases backwards
    assert readings[1:-1].max() == 0.0


def test_angle_just_below_zero_stays_in_range():
    readings = pseudo_lidar(np.array([[1.0, -1e-17]]), np.array([1]), 2)
    assert readings.max() == pytest.approx(2 / 3)
    assert readings[:LIDAR_BINS].max() == 0.0


def test_nothing_beyond_the_range():
    assert not pseudo_lidar(np.array([[3.0, 0.1], [1e3, 1e3]]), np.array([0, 0]), 1).any()
