"""Distances of zero moment points from edges, all at once: statics, and polygons built one by one."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles import support_margin

from safe_wrappers.control.contact import tangents
from safe_wrappers.control.legged import support_distances

UP = np.array([0.0, 0.0, 1.0])
CORNERS = np.array([[0.2, 0.1, 0.0], [-0.2, 0.1, 0.0], [-0.2, -0.1, 0.0], [0.2, -0.1, 0.0]])
UPRIGHT = np.tile(UP, (4, 1))


def one_by_one(instant, points, normals, forces):
    """Each instant's, by the polygon's corners, sorted."""
    found = []
    for when in np.unique(instant):
        here = instant == when
        margin = support_margin(points[here], normals[here], forces[here])
        if np.isfinite(margin):
            found.append(margin)
    return np.sort(found)


@pytest.mark.parametrize(
    ("shares", "distance"),
    [
        ([1, 1, 1, 1], 0.1),
        ([1, 0, 0, 1], 0.0),  # it begins to tip
        ([9, 1, 1, 9], 0.04),  # 0.16 ahead of the middle
        ([0, 0, 0, 1], 0.0),
        ([-1, 3, 3, -1], -0.2),  # beyond an edge: something pulls
        ([0, -1, 0, 2], -np.hypot(0.4, 0.2)),  # beyond a corner: at (0.6, -0.3)
    ],
)
def test_a_pressed_square(shares, distance):
    forces = np.outer(shares, UP)
    assert support_distances(np.zeros(4), CORNERS, UPRIGHT, forces) == pytest.approx([distance], abs=1e-12)
    assert one_by_one(np.zeros(4), CORNERS, UPRIGHT, forces) == pytest.approx([distance], abs=1e-12)


@pytest.mark.parametrize(
    "change",
    [
        lambda p, n, f: (p + np.outer([0, 0, 0, 0.05], UP), n, f),  # several heights
        lambda p, n, f: (p, np.array([UP, UP, UP, [0.1, 0.0, np.sqrt(0.99)]]), f),  # a slope beside the plane
        lambda p, n, f: (p * [1, 0, 1], n, f),  # on a line
        lambda p, n, f: (p * 0, n, f),  # at a point
        lambda p, n, f: (p, n, 0 * f),  # nothing presses
        lambda p, n, f: (p, np.outer([1, -1, 1, -1], UP), f),  # a wedge
        lambda p, n, f: (p[:2], n[:2], f[:2]),
        lambda p, n, f: (p[:0], n[:0], f[:0]),
    ],
)
def test_what_is_no_support_gives_no_number_and_harms_no_other(change):
    p, n, f = change(CORNERS, UPRIGHT, UPRIGHT)
    assert support_distances(np.zeros(len(p)), p, n, f).shape == (0,)
    both = [np.concatenate([a, b, a]) for a, b in zip((p, n, f), (CORNERS, UPRIGHT, UPRIGHT), strict=True)]
    instant = np.repeat([4, 5, 6], [len(p), 4, len(p)])
    assert support_distances(instant, *both) == pytest.approx([0.1])


@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.integers(0, 40), st.booleans(), st.booleans())
def test_as_one_by_one(seed, instants, contacts, coarse, rough):
    rng = np.random.default_rng(seed)
    normal = UP + rng.normal(0.0, 0.5, 3)
    normal /= np.linalg.norm(normal)
    flat = rng.uniform(-1.0, 1.0, (contacts, 2))
    flat = np.round(flat, 1) if coarse else flat  # with duplicates, and several on one edge
    heights = rng.uniform(-0.007, 0.007, (contacts, 1)) * rough
    points = flat @ tangents(normal) + heights * normal + [3.0, -2.0, 1.0]
    normals = normal + rng.normal(0.0, 0.02, (contacts, 3)) * rough
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    forces = rng.normal(0.0, 1.0, (contacts, 3)) + rng.uniform(0.5, 3.0) * normal
    instant = rng.integers(0, instants, contacts)
    expected = one_by_one(instant, points, normals, forces)
    np.testing.assert_allclose(
        np.sort(support_distances(instant, points, normals, forces)), expected, rtol=1e-6, atol=1e-9
    )
