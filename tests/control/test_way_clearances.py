"""Clearances of ways against distances computed point by point, by NumPy."""

import numpy as np
import pytest

from safe_wrappers.control.backup.way_clearances import Around, least_left, way_clearances


def scene(rng, boxes, discs, planes, instants=6):
    """What is around a machine near the origin, and what the discs and planes leave now."""
    centers, halves = rng.uniform(-2, 2, (instants, boxes, 2)), rng.uniform(0, 0.5, (instants, boxes, 2))
    here = rng.uniform(-0.2, 0.2, 2)
    rows = np.column_stack([rng.uniform(-2, 2, (discs, 2)), rng.uniform(0.1, 0.4, discs), np.zeros(discs)])
    rows[:, 3] = np.hypot(*(rows[:, :2] - here).T) - rows[:, 2]
    angles = rng.uniform(-np.pi, np.pi, planes)
    normals = np.column_stack([np.cos(angles), np.sin(angles)])
    walls = np.column_stack([-normals * rng.uniform(0.5, 3, (planes, 1)), normals, np.zeros((planes, 2))])
    walls[:, 4] = 0.1
    walls[:, 5] = ((here - walls[:, :2]) * normals).sum(axis=1) - 0.1
    bounds = (centers - halves).min(axis=0), (centers + halves).max(axis=0)
    return Around(centers, halves, rng.uniform(0.1, 0.3, boxes), *bounds, rows, walls, here)


def by_points(x, y, around):
    """Clearances from each box, disc and plane, shape (obstacles, c, m, k)."""
    found = []
    for i, size in enumerate(around.sizes):
        (cx, cy), (hx, hy) = around.centers[:, i].T, around.halves[:, i].T
        found.append(np.hypot(np.maximum(abs(x - cx) - hx, 0), np.maximum(abs(y - cy) - hy, 0)) - size)
    found += [np.hypot(x - a, y - b) - size for a, b, size, _ in around.discs]
    found += [(x - a) * n + (y - b) * m - size for a, b, n, m, size, _ in around.planes]
    return np.array(found)


@pytest.mark.parametrize("seed", range(20))
def test_the_nearest_of_all_counts(seed):
    rng = np.random.default_rng(seed)
    around = scene(rng, *rng.integers(0, 4, 2), planes=1 + seed % 3)
    x, y = rng.uniform(-1.5, 1.5, (2, 3, 4, 6))
    found = way_clearances(x, y, around, margin=10.0)  # so that nothing is far
    np.testing.assert_allclose(found, by_points(x, y, around).min(axis=0), rtol=0, atol=1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_what_is_left_out_as_far_leaves_more_than_the_margin(seed):
    rng = np.random.default_rng(seed)
    around = scene(rng, 5, 5, 3)
    x, y = around.here[:, None, None, None] + rng.uniform(-0.3, 0.3, (2, 3, 4, 6))
    found, each = way_clearances(x, y, around, 0.05), by_points(x, y, around)
    counted = np.array([np.isclose(found, part, rtol=0, atol=1e-12).any() for part in each])
    assert (found >= each.min(axis=0) - 1e-12).all()
    assert each[:, found > each.min(axis=0) + 1e-12].min(initial=np.inf) > 0.05
    assert not counted.all() or np.isfinite(found).all()


def test_the_worst_instant_counts_and_no_number_is_not_clear():
    left = least_left(np.array([[[1.0, 0.4, 2.0], [np.inf, 3.0, np.nan]]]), np.array([0.1, 0.2, 0.3]))
    assert left[0, 0] == pytest.approx(0.2)
    assert np.isnan(left[0, 1])
