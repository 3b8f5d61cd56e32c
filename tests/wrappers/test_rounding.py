"""Casting never breaks a row that held, and never moves a component by more than one unit in the last place."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.control.numerics.projection import cast_inside

unit = st.floats(-1.0, 1.0)


@given(st.lists(st.tuples(unit, unit), min_size=1, max_size=5))
def test_the_cast_control_keeps_the_row_that_the_exact_one_kept(pairs):
    control, normal = (np.array(side) for side in zip(*pairs, strict=True))
    normals, offsets = normal[None, :], np.array([normal @ control])
    low, high = -np.ones(control.size), np.ones(control.size)
    sent = cast_inside(control, np.float32, normals, offsets, low, high)
    assert sent.dtype == np.float32 and (np.abs(sent) <= 1.0).all()
    assert np.abs(sent - control).max() <= 2.0 * np.finfo(np.float32).eps
    assert normal @ sent.astype(np.float64) <= offsets[0] + 1e-15


def test_rounding_alone_would_break_it():
    control, normals = np.array([0.1]), np.array([[1.0]])
    assert float(np.float32(0.1)) > 0.1
    sent = cast_inside(control, np.float32, normals, np.array([0.1]), -np.ones(1), np.ones(1))
    assert float(sent[0]) <= 0.1


def test_float64_is_left_alone():
    control = np.array([1 / 3])
    sent = cast_inside(control, np.float64, np.array([[1.0]]), control, -np.ones(1), np.ones(1))
    assert sent[0] == control[0]
