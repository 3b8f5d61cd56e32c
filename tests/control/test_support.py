"""Support polygons and the rows on forces over them, against hulls by scipy and zero moment points by hand."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from oracles import margin_inside, support_margin
from scipy.spatial import ConvexHull

from safe_wrappers.control.legged.support import common_plane, plane, support_polygon, support_rows
from safe_wrappers.errors import ConfigurationError

UP = np.array([0.0, 0.0, 1.0])
GROUND = plane([0.0, 0.0, 0.0], UP)
CORNERS = np.array([[0.2, 0.1, 0.0], [-0.2, 0.1, 0.0], [-0.2, -0.1, 0.0], [0.2, -0.1, 0.0]])
flat_points = st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1)), min_size=3, max_size=12)


@given(flat_points)
def test_the_polygon_is_the_convex_hull(points):
    given_points = np.array(points)
    centred = given_points - given_points.mean(axis=0)
    assume(np.linalg.svd(centred, compute_uv=False)[-1] > 1e-3)
    polygon = support_polygon(given_points)
    hull = ConvexHull(given_points)
    x, y = polygon.T
    area = 0.5 * float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())  # positive: anticlockwise
    assert area == pytest.approx(hull.volume, abs=1e-9)
    margins = [margin_inside(p, polygon) for p in given_points]
    assert min(margins) > -1e-9


def test_a_grid_has_four_corners():
    grid = np.stack(np.meshgrid(np.arange(3.0), np.arange(3.0)), axis=-1).reshape(-1, 2) * 0.1
    assert sorted(map(tuple, support_polygon(grid).round(12))) == [(0, 0), (0, 0.2), (0.2, 0), (0.2, 0.2)]


def test_a_line_or_a_point_of_support_has_no_third_corner():
    line = support_polygon([[0.0, 0.0], [1.0, 0.0], [0.5, 0.0]])
    assert line.tolist() == [[0.0, 0.0], [1.0, 0.0]]
    assert support_polygon([[1.0, 1.0], [1.0, 1.0]]).tolist() == [[1.0, 1.0]]


def test_contacts_at_several_heights_have_no_common_plane():
    normals = np.tile(UP, (4, 1))
    stairs = CORNERS + np.array([0.0, 0.15, 0.15, 0.0])[:, None] * UP
    assert common_plane(stairs, normals) is None
    # A wall beside a floor is no common plane either.
    assert common_plane(CORNERS[:2], np.array([UP, [1.0, 0.0, 0.0]])) is None
    ridge = np.array([[0.0, 0.1, 0.0], [0.0, -0.1, 0.0]])  # level with the mean of two normals, which differ
    assert common_plane(ridge, np.array([UP, [1.0, 0.0, 0.0]])) is None
    assert common_plane(ridge, np.array([UP, [math.sin(0.04), 0.0, math.cos(0.04)]])) is not None
    assert common_plane(np.zeros((0, 3)), np.zeros((0, 3))) is None
    # One inclined plane is: height alone does not decide.
    slope = np.array([-math.sin(0.3), 0.0, math.cos(0.3)])
    tilted = CORNERS @ np.array(
        [[math.cos(0.3), 0, math.sin(0.3)], [0, 1, 0], [-math.sin(0.3), 0, math.cos(0.3)]]
    )
    shared = common_plane(tilted, np.tile(slope, (4, 1)))
    assert shared is not None
    assert shared.normal == pytest.approx(slope)
    within = CORNERS + np.array([0.004, 0.0, 0.0, 0.0])[:, None] * UP
    assert common_plane(within, normals) is not None
    assert common_plane(within, normals, tolerance_m=0.001) is None


@given(
    st.lists(st.floats(0.0, 10.0), min_size=5, max_size=5),
    st.lists(st.tuples(st.floats(-3, 3), st.floats(-3, 3)), min_size=5, max_size=5),
    st.floats(0.0, 0.12),
    st.integers(0, 100),
)
def test_rows_on_the_forces_say_what_the_margin_says(pressures, sideways, inset, seed):
    rng = np.random.default_rng(seed)
    points = np.concatenate([rng.uniform(-0.3, 0.3, (5, 2)), np.zeros((5, 1))], axis=1)
    forces = np.concatenate([np.array(sideways), np.array(pressures)[:, None]], axis=1)
    assume(sum(pressures) > 0.1)
    margin = support_margin(points, np.tile(UP, (5, 1)), forces) - inset
    excess = (support_rows(points, plane([0.0, 0.0, 0.0], UP), inset) @ forces.ravel()).max()
    # In newtons times metres over newtons: the inside margin itself.
    if margin >= 0.0:
        assert -excess / sum(pressures) == pytest.approx(margin, abs=1e-9)
    else:
        assert excess > 0.0 or margin > -1e-12


def test_a_line_allows_no_pressure_once_an_inset_is_asked_for():
    ground = plane([0.0, 0.0, 0.0], UP)
    rows = support_rows(CORNERS[:2], ground, 0.05)
    assert (rows @ np.tile(UP, (2, 1)).ravel()).max() > 0.0
    assert (rows @ np.zeros(6)).max() <= 0.0
    assert (support_rows(CORNERS[:2], ground, 0.0) @ np.tile(UP, (2, 1)).ravel()).max() <= 0.0


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: support_polygon(np.zeros((0, 2))), "at least one"),
        (lambda: support_polygon(np.zeros((3, 3))), "shape"),
        (lambda: support_rows(CORNERS, GROUND, math.nan), "inset"),
        (lambda: plane([0, 0, 0], [0, 0, 2]), "length 1"),
        (lambda: common_plane(np.zeros((2, 2)), np.zeros((2, 2))), "shape"),
    ],
)
def test_bad_input_is_refused(call, said):
    with pytest.raises(ConfigurationError, match=said):
        call()
