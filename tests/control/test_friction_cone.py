"""Friction cones: their frame, and a force that is not known."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.control.contact import cone_excess, tangents

UP = np.array([0.0, 0.0, 1.0])
directions = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)


def unit(v):
    return np.array(v) / np.linalg.norm(v)


@given(directions)
def test_tangents_are_a_right_handed_frame(normal):
    n = unit(normal)
    axes = np.vstack([tangents(n), n])
    assert np.allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)


def test_an_unknown_force_has_no_excess():
    assert math.isnan(cone_excess([0, 0, math.nan], UP, 0.5))
