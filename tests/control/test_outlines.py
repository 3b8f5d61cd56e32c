"""Convex outlines against SciPy's hull and against a finely sampled boundary."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial import ConvexHull

from safe_wrappers.control.numerics.shapes import convex_outline, distance_to_outline

GRID = st.integers(-20, 20).map(lambda n: n / 100.0)  # coarse: many points on one edge, many twice
CLOUDS = arrays(np.float64, st.tuples(st.integers(3, 15), st.just(2)), elements=GRID)


def spread(points):
    """Whether the points span an area."""
    return np.linalg.matrix_rank(points - points[0], tol=1e-9) == 2


@given(CLOUDS)
def test_the_outline_is_the_convex_hull(points):
    """Its corners are points of the cloud, and it encloses the area that SciPy's hull does, counter-clockwise."""
    assume(spread(points))
    outline = convex_outline(points)
    assert {tuple(p) for p in outline} <= {tuple(p) for p in points}
    x, y = outline.T
    area = 0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1))
    assert area == pytest.approx(ConvexHull(points).volume, abs=1e-12)
    assert max(distance_to_outline(outline, *point) for point in points) <= 1e-12


@given(CLOUDS, arrays(np.float64, (4, 2), elements=st.floats(-0.4, 0.4)))
def test_distances_are_those_to_the_boundary_negative_inside(cloud, points):
    assume(spread(cloud))
    outline = convex_outline(cloud)
    share = np.linspace(0.0, 1.0, 401)[:, None]
    sides = zip(outline, np.roll(outline, -1, axis=0), strict=True)
    boundary = np.concatenate([a + share * (b - a) for a, b in sides])
    found = np.array([distance_to_outline(outline, *point) for point in points])
    to_boundary = np.linalg.norm(points[:, None] - boundary, axis=2).min(axis=1)
    np.testing.assert_allclose(np.abs(found), to_boundary, atol=1e-3)  # a side of 0.57 m in 400 parts
    planes = ConvexHull(cloud).equations
    beyond = (points @ planes[:, :2].T + planes[:, 2]).max(axis=1)
    clear = np.abs(beyond) > 1e-9
    assert ((found > 0.0) == (beyond > 0.0))[clear].all()


@pytest.mark.parametrize("points", [[[0, 0], [1, 1]], [[0, 0], [1, 1], [2, 2]], [[1, 1]] * 4])
def test_points_on_one_line_have_no_outline(points):
    with pytest.raises(ValueError, match="three points that are not on one line"):
        convex_outline(np.array(points, dtype=float))
