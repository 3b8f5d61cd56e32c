"""Zero moment point and support polygon against statics, hulls by scipy and brute force."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from safe_wrappers.appendix.legged.balance import balance, support_margin, zmp_of_forces, zmp_of_motion
from safe_wrappers.appendix.legged.centroidal import momentum_rate
from safe_wrappers.control.legged.support import common_plane, plane, support_polygon, support_rows
from safe_wrappers.errors import ConfigurationError

UP = np.array([0.0, 0.0, 1.0])
G = np.array([0.0, 0.0, -9.81])
GROUND = plane([0.0, 0.0, 0.0], UP)
CORNERS = np.array([[0.2, 0.1, 0.0], [-0.2, 0.1, 0.0], [-0.2, -0.1, 0.0], [0.2, -0.1, 0.0]])
SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
flat_points = st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1)), min_size=3, max_size=12)


def test_a_standing_box_presses_below_its_centre():
    forces = np.tile(UP, (4, 1)) * 9.81 / 4
    found = balance(CORNERS, np.tile(UP, (4, 1)), forces, inset=0.03)
    assert found.coplanar
    assert found.zmp == pytest.approx([0.0, 0.0, 0.0])
    assert found.margin == pytest.approx(0.07)


def test_a_pushed_box_presses_ahead_or_behind():
    # Accelerated forwards at a, a centre of mass at height h has its zero moment point h a / g behind it.
    com, a, h = np.array([0.05, 0.0, 0.4]), 1.2, 0.4
    zmp = zmp_of_motion(3.0, com, [a, 0.0, 0.0], [0.0, 0.0, 0.0], G, GROUND)
    assert zmp == pytest.approx([0.05 - h * a / 9.81, 0.0, 0.0])


@given(
    st.lists(st.tuples(*[st.floats(-1, 1)] * 6, st.floats(-1, 1)), min_size=1, max_size=6),
    st.tuples(*[st.floats(-1, 1)] * 3),
    st.tuples(*[st.floats(-1, 1)] * 2),
)
def test_forces_and_the_motion_they_make_have_one_zero_moment_point(contacts, com, tilt):
    rows = np.array(contacts)
    points, forces, moments = rows[:, :3], rows[:, 3:6] + [0.0, 0.0, 1.5], rows[:, 6:] * UP
    n = np.array([*tilt, 2.0])
    ground = plane([0.1, 0.2, 0.3], n / np.linalg.norm(n))
    assume(float(forces.sum(axis=0) @ ground.normal) > 0.1)
    linear, angular = momentum_rate(2.0, com, G, points, forces, moments)
    by_motion = zmp_of_motion(2.0, com, linear / 2.0, angular, G, ground)
    by_forces = zmp_of_forces(points, forces, ground, moments)
    assert by_forces == pytest.approx(by_motion, abs=1e-9)
    # It is on the plane, and there the moment has no tangential part.
    assert float((by_forces - ground.origin) @ ground.normal) == pytest.approx(0.0, abs=1e-9)
    moment = (np.cross(points - by_forces, forces) + moments).sum(axis=0)
    assert ground.axes @ moment == pytest.approx([0.0, 0.0], abs=1e-8)


@pytest.mark.parametrize("vertical", [0.0, -1.0])
def test_where_nothing_presses_there_is_no_such_point(vertical):
    forces = np.tile(UP, (4, 1)) * vertical
    assert np.isnan(zmp_of_forces(CORNERS, forces, GROUND)).all()
    assert math.isnan(balance(CORNERS, np.tile(UP, (4, 1)), forces).margin)


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
    margins = [support_margin(p, polygon) for p in given_points]
    assert min(margins) > -1e-9


def test_a_grid_has_four_corners():
    grid = np.stack(np.meshgrid(np.arange(3.0), np.arange(3.0)), axis=-1).reshape(-1, 2) * 0.1
    assert sorted(map(tuple, support_polygon(grid).round(12))) == [(0, 0), (0, 0.2), (0.2, 0), (0.2, 0.2)]


@given(st.floats(-2.0, 3.0), st.floats(-2.0, 3.0))
def test_the_margin_of_a_square_in_closed_form(x, y):
    outside = math.hypot(max(-x, x - 1.0, 0.0), max(-y, y - 1.0, 0.0))
    expected = -outside if outside > 0.0 else min(x, 1.0 - x, y, 1.0 - y)
    assert support_margin([x, y], SQUARE) == pytest.approx(expected, abs=1e-12)
    assert support_margin([x, y], SQUARE, inset=0.2) == pytest.approx(expected - 0.2, abs=1e-12)


def test_a_line_or_a_point_of_support_has_no_inside():
    line = support_polygon([[0.0, 0.0], [1.0, 0.0], [0.5, 0.0]])
    assert line.tolist() == [[0.0, 0.0], [1.0, 0.0]]
    assert support_margin([0.5, 0.0], line) == 0.0
    assert support_margin([0.5, 0.0], line, inset=0.1) == pytest.approx(-0.1)
    assert support_margin([0.5, 0.3], line) == pytest.approx(-0.3)
    assert support_margin([1.4, 0.3], line) == pytest.approx(-0.5)
    point = support_polygon([[1.0, 1.0], [1.0, 1.0]])
    assert support_margin([1.0, 1.0], point) == 0.0
    assert support_margin([4.0, 5.0], point) == pytest.approx(-5.0)


def test_contacts_at_several_heights_are_flagged_and_get_no_number():
    normals, forces = np.tile(UP, (4, 1)), np.tile(UP, (4, 1))
    stairs = CORNERS + np.array([0.0, 0.15, 0.15, 0.0])[:, None] * UP
    found = balance(stairs, normals, forces)
    assert not found.coplanar
    assert np.isnan(found.zmp).all()
    assert math.isnan(found.margin)
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
    margin = balance(points, np.tile(UP, (5, 1)), forces, inset).margin
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
        (lambda: support_margin([0.0], SQUARE), "point"),
        (lambda: support_margin([0.0, 0.0], SQUARE, inset=-1.0), "inset"),
        (lambda: support_rows(CORNERS, GROUND, math.nan), "inset"),
        (lambda: plane([0, 0, 0], [0, 0, 2]), "length 1"),
        (lambda: common_plane(np.zeros((2, 2)), np.zeros((2, 2))), "shape"),
        (lambda: zmp_of_forces([[0, 0, math.inf]], [[0, 0, 1]], GROUND), "finite"),
    ],
)
def test_bad_input_is_refused(call, said):
    with pytest.raises(ConfigurationError, match=said):
        call()


def test_a_point_that_is_not_a_number_has_no_margin():
    assert math.isnan(support_margin([math.nan, 0.0], SQUARE))
