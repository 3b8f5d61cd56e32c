"""Compiled and plain Python: the same bits of what `Clearance` and `CoastingClearance` compute."""

import hashlib

import numpy as np

from safe_wrappers.control.backup import approach_rows as of
from safe_wrappers.control.numerics import surfaces
from safe_wrappers.control.numerics.planar import clearances_on_a_course, convex_outline


def some_surfaces(rng, d):
    """Planes, rounds and blocks of up to d coordinates."""
    found = np.zeros((7, surfaces.NUMBERS))
    for row in found:
        kind, n = rng.choice([surfaces.PLANE, surfaces.ROUND, surfaces.BLOCK]), rng.integers(1, d + 1)
        row[:2], row[2 : 2 + n] = (kind, n), rng.uniform(-1.0, 1.0, n)
        row[5 : 5 + n] = rng.uniform(0.1, 0.5, n)
        if kind == surfaces.PLANE:
            row[5 : 5 + n] /= np.sqrt((row[5 : 5 + n] ** 2).sum())
    return found


def random_looks(count):
    """Every function on random scenes, as one digest, and how many rows there were."""
    rng, digest, rows = np.random.default_rng(5), hashlib.sha256(), 0
    for i in range(count):
        d, m = int(rng.integers(1, 4)), int(rng.integers(1, 4))
        point, v, drift = rng.normal(size=(3, d))
        if i % 50 == 0:
            v[0] = np.nan
        effect, low, high = rng.normal(size=(d, m)), -rng.uniform(0.0, 2.0, m), rng.uniform(0.0, 2.0, m)
        if i % 3 == 0:
            high[0] = np.inf
        always = low, high, 0.01, 0.05, 0.1, 2.0, 0.02
        scene = some_surfaces(rng, d)
        found = of.approach_rows_of(scene, point, v, drift, effect, always)
        near = surfaces.nearest_points(scene, point)
        moving = rng.normal(size=near[1].shape)
        found += of.approach_rows(near[0], near[1], moving, near[2], v, drift, effect, always)
        found += of.out_of_reach(some_surfaces(rng, 3), np.abs(rng.normal(size=18 + m)), always)
        outline = convex_outline(rng.normal(size=(6, 2))) if i % 2 else np.zeros((0, 2))
        ahead = rng.normal(size=(3, 2))
        ahead /= np.sqrt((ahead**2).sum(axis=1))[:, None]
        places, discs = rng.normal(size=(3, 2)), np.abs(rng.normal(size=(4, 3)))
        found += (clearances_on_a_course(outline, places, ahead, discs),)
        for part in found:
            part = np.asarray(part, dtype=np.float64)
            digest.update(np.where(np.isnan(part), np.nan, part).tobytes())  # the sign of one is left open
        rows += len(found[2]) + len(found[5])
    return digest.hexdigest(), rows


def test_the_random_scenes_have_rows():
    assert random_looks(200)[1] > 100


def test_a_row_that_is_not_a_number_is_kept():
    wall = np.array([[surfaces.PLANE, 1.0, -9.0, 0.0, 0.0, 1.0, 0.0, 0.0]])
    always = np.array([-1.0]), np.array([1.0]), 0.0, 0.05, 0.0, 2.0, 0.0
    for drift, rows in ((0.0, 0), (np.nan, 1)):
        found = of.approach_rows_of(
            wall, np.zeros(1), np.zeros(1), np.array([drift]), np.ones((1, 1)), always
        )
        assert found[1].shape == (rows, 1) and found[2].shape == (rows,)
    reach = np.ones(19)
    assert of.out_of_reach(wall, reach, always)[1]
    reach[6] = np.nan
    assert not of.out_of_reach(wall, reach, always)[1]
