"""Friction cones: forces on a slope, pyramids inside their cones, MuJoCo's own pyramid."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.control.contact import (
    cone_excess,
    friction_pyramid,
    tangents,
)
from safe_wrappers.errors import ConfigurationError

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


def reach(rows, normal, tangent):
    """How far along a tangent the rows allow a force with one newton along the normal."""
    slope, at = rows @ tangent, -(rows @ normal)
    return float(np.min(at[slope > 1e-12] / slope[slope > 1e-12]))


@given(directions, st.floats(0.01, 3.0), st.integers(3, 40), st.floats(0.0, math.tau))
def test_a_pyramid_is_inside_its_cone_for_any_number_of_edges(normal, friction, edges, angle):
    n = unit(normal)
    rows = friction_pyramid(n, friction, edges)
    one, two = tangents(n)
    farthest = reach(rows, n, math.cos(angle) * one + math.sin(angle) * two)
    assert friction * math.cos(math.pi / edges) * (1 - 1e-9) <= farthest <= friction * (1 + 1e-9)
    # Its edges are on the cone, the middles of its sides where the figure says.
    assert reach(rows, n, one) == pytest.approx(friction)
    half = math.pi / edges
    middle = math.cos(half) * one + math.sin(half) * two
    assert reach(rows, n, middle) == pytest.approx(friction * math.cos(half))


def test_four_edges_on_a_floor_are_mujocos_pyramid():
    first, second = np.eye(3)[:2]
    rows = friction_pyramid(UP, 0.8, 4)
    for force in np.random.default_rng(0).normal(0.5, 1.0, size=(500, 3)):
        inside = abs(force @ first) + abs(force @ second) <= 0.8 * force[2]
        assert (rows @ force <= 0.0).all() == inside


def test_what_is_no_pyramid_is_refused_and_an_unknown_force_has_no_excess():
    with pytest.raises(ConfigurationError, match="edges"):
        friction_pyramid(UP, 0.5, 2)
    assert math.isnan(cone_excess([0, 0, math.nan], UP, 0.5))
