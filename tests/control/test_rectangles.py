"""Distances of rectangles against points sampled on them; merging against the area covered."""

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from safe_wrappers.control.numerics.shapes import apart, closer, gaps, merged, nearest

NUMBERS = st.floats(-3.0, 3.0).map(lambda x: round(x, 3))
SIDES = st.lists(NUMBERS, min_size=2, max_size=2, unique=True).map(sorted)
RECTANGLES = st.builds(lambda x, y: (*x, *y), SIDES, SIDES)


def corner_points(r):
    """A grid over the rectangle, its border included."""
    x, y = np.meshgrid(np.linspace(r[0], r[1], 9), np.linspace(r[2], r[3], 9))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def from_point(p, r):
    """Euclidean distance of a point from a rectangle, 0 inside."""
    return math.hypot(max(r[0] - p[0], p[0] - r[1], 0.0), max(r[2] - p[1], p[1] - r[3], 0.0))


def overlap(a, b):
    return max(a[0], b[0]) < min(a[1], b[1]) and max(a[2], b[2]) < min(a[3], b[3])


@given(RECTANGLES, RECTANGLES)
def test_outside_it_is_the_euclidean_distance(a, b):
    if overlap(a, b):
        assert apart(a, b) < 0.0
        return
    # The nearest point of a is the one that b's interval, clipped onto a's, starts or ends at.
    p = (max(a[0], min(b[0], a[1])), max(a[2], min(b[2], a[3])))
    q = (max(a[0], min(b[1], a[1])), max(a[2], min(b[3], a[3])))
    close = min(from_point((x, y), b) for x in (p[0], q[0]) for y in (p[1], q[1]))
    assert apart(a, b) == pytest.approx(close, abs=1e-12)
    assert min(from_point(s, b) for s in corner_points(a)) >= apart(a, b) - 1e-12


@given(RECTANGLES, RECTANGLES)
def test_inside_it_is_the_shortest_way_out_along_an_axis(a, b):
    if not overlap(a, b):
        return
    depth = -apart(a, b)
    assert depth == -max(gaps(a, b))

    def moved(dx, dy):
        return (a[0] + dx, a[1] + dx, a[2] + dy, a[3] + dy)

    ways = [(1, 0), (-1, 0), (0, 1), (0, -1)]
    assert any(not overlap(moved(x * depth * 1.001, y * depth * 1.001), b) for x, y in ways)
    assert all(overlap(moved(x * depth * 0.999, y * depth * 0.999), b) for x, y in ways)


@given(RECTANGLES, st.lists(RECTANGLES, max_size=6), st.floats(0.0, 3.0))
@example((0.0, 2.458, 0.0, 1.0), [(2.897, 3.0, 0.0, 1.0)], 0.43899999999999967)  # the sum is rounded, too
def test_nearest_and_closer_agree_with_every_single_distance(around, among, limit):
    distances = [apart(around, r) for r in among]
    rows = np.array(among, dtype=np.float64).reshape(-1, 4)
    close = [i for i, distance in enumerate(distances) if distance < limit]
    for first in range(len(among) + 1):
        assert closer(around, rows, limit, first) == next((i for i in close if i >= first), -1)
    best, found = nearest(around, rows, limit)
    assert best == min([limit, *distances])
    assert found == -1 if best == limit else apart(around, among[found]) == best


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), max_size=25), st.floats(0.3, 2.0))
def test_merged_covers_the_same_cells_and_nothing_else(cells, size):
    squares = [(i * size, (i + 1) * size, j * size, (j + 1) * size) for i, j in cells]
    joined = merged(squares)
    assert len(joined) <= len(squares)
    for i in range(6):
        for j in range(6):
            centre = ((i + 0.5) * size, (j + 0.5) * size)
            assert any(from_point(centre, r) == 0.0 for r in joined) == ((i, j) in cells)
