"""Outlines by SciPy's hull and a sampled boundary, discs from a moving frame, and the cells rectangles cover."""

import hashlib

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial import ConvexHull

from safe_wrappers.control.shapes import (
    clearances_on_a_course,
    convex_outline,
    distance_to_outline,
    merged,
    nearest_discs,
)

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


def scene(rng, corners):
    """An outline, places, directions and discs."""
    outline = convex_outline(rng.normal(size=(6, 2))) if corners else np.zeros((0, 2))
    ahead = rng.normal(size=(3, 2))
    ahead /= np.sqrt((ahead**2).sum(axis=1))[:, None]
    return outline, rng.normal(size=(3, 2)), ahead, np.abs(rng.normal(size=(4, 3)))


def random_looks(count):
    """Clearances in random scenes, as one digest."""
    rng, digest = np.random.default_rng(5), hashlib.sha256()
    for i in range(count):
        digest.update(clearances_on_a_course(*scene(rng, i % 2)).tobytes())
    return digest.hexdigest()


@given(st.integers(0, 2**31), st.booleans())
def test_clearances_on_a_course_are_distances_in_the_bodys_frame(seed, corners):
    outline, places, ahead, discs = scene(np.random.default_rng(seed), corners)
    found = clearances_on_a_course(outline, places, ahead, discs)
    for k, i in np.ndindex(found.shape):
        x, y = np.column_stack([ahead[k], [-ahead[k, 1], ahead[k, 0]]]).T @ (discs[i, :2] - places[k])
        distance = distance_to_outline(outline, x, y) if corners else np.hypot(x, y)
        assert found[k, i] == pytest.approx(distance - discs[i, 2], abs=1e-12)


@given(st.integers(0, 2**31), st.integers(0, 4), st.integers(0, 4), st.floats(-4.0, 4.0))
def test_the_nearest_discs_come_first_as_seen_from_a_moving_frame(seed, discs, count, heading):
    rng = np.random.default_rng(seed)
    given_, place, velocity = np.abs(rng.normal(size=(discs, 3))), rng.normal(size=2), rng.normal(size=2)
    found = nearest_discs(given_, *place, heading, *velocity, count).reshape(count, 4)
    to = given_[:, :2] - place
    away = np.linalg.norm(to, axis=1)
    gaps, to = away - given_[:, 2], to / away[:, None]
    frame = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
    squash = lambda value: value / (1.0 + np.abs(value))  # noqa: E731
    seen = np.column_stack([to @ frame.T, squash(gaps), squash(to @ velocity)])[np.argsort(gaps)][:count]
    np.testing.assert_allclose(found[: len(seen)], seen, atol=1e-12)
    assert (found[len(seen) :] == [0.0, 0.0, 1.0, 0.0]).all()  # the rest is far away


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
