"""Convex outlines and joined rectangles: SciPy's hull, a finely sampled boundary, and the cells that are covered."""

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial import ConvexHull

from safe_wrappers.control.numerics.shapes import convex_outline, distance_to_outline, merged

GRID = st.integers(-20, 20).map(lambda n: n / 100.0)  # coarse: many points on one edge, many twice
CLOUDS = arrays(np.float64, st.tuples(st.integers(3, 15), st.just(2)), elements=GRID)


@given(CLOUDS, arrays(np.float64, (4, 2), elements=st.floats(-0.4, 0.4)))
def test_the_outline_is_the_convex_hull_and_distances_are_those_to_its_boundary(cloud, points):
    assume(np.linalg.matrix_rank(cloud - cloud[0], tol=1e-9) == 2)
    outline, hull = convex_outline(cloud), ConvexHull(cloud)
    assert {tuple(p) for p in outline} <= {tuple(p) for p in cloud}
    after = np.roll(outline, -1, axis=0)
    area = 0.5 * (outline[:, 0] * after[:, 1] - outline[:, 1] * after[:, 0]).sum()
    np.testing.assert_allclose(area, hull.volume, atol=1e-12)  # counter-clockwise
    assert max(distance_to_outline(outline, *point) for point in cloud) <= 1e-12
    share = np.linspace(0.0, 1.0, 401)[:, None]
    boundary = (outline[:, None] + share * (after - outline)[:, None]).reshape(-1, 2)
    found = np.array([distance_to_outline(outline, *point) for point in points])
    to_boundary = np.linalg.norm(points[:, None] - boundary, axis=2).min(axis=1)
    np.testing.assert_allclose(np.abs(found), to_boundary, atol=1e-3)  # a side of 0.57 m in 400 parts
    beyond = (points @ hull.equations[:, :2].T + hull.equations[:, 2]).max(axis=1)
    clear = np.abs(beyond) > 1e-9
    assert ((found > 0.0) == (beyond > 0.0))[clear].all()


def covers(r, x, y):
    return r[0] <= x <= r[1] and r[2] <= y <= r[3]


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), max_size=25), st.floats(0.3, 2.0))
def test_merged_covers_the_same_cells_and_nothing_else(cells, size):
    squares = [(i * size, (i + 1) * size, j * size, (j + 1) * size) for i, j in cells]
    joined = merged(squares)
    assert len(joined) <= len(squares)
    for i, j in np.ndindex(6, 6):
        covered = any(covers(r, (i + 0.5) * size, (j + 0.5) * size) for r in joined)
        assert covered == ((i, j) in cells)
