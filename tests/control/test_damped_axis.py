"""A held axis and evasive manoeuvres against single physics steps; clearances of ways by NumPy, point by point."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles import held, to_rest

from safe_wrappers.control.backup import damped_axis as of
from safe_wrappers.control.backup.evasive_maneuvers import Around, least_left, ways

SPEEDS = st.floats(-7.0, 7.0).map(lambda v: round(v, 6))
AXES = st.builds(
    of.damped_axis,
    decay=st.floats(0.8, 1.0),
    gain=st.floats(0.01, 0.5),
    timestep=st.sampled_from([0.002, 0.01, 0.05]),
    substeps=st.integers(1, 6),
    low=st.floats(-2.0, -0.2),
    high=st.floats(0.2, 2.0),
    clip=st.floats(1.0, 6.0),
)


@given(AXES, st.floats(-3.0, 3.0), SPEEDS, st.floats(-3.0, 3.0))
def test_a_hold_is_its_physics_steps(axis, x, v, u):
    xs, after = held(axis, x, v, u)
    assert of.step(axis, x, of.clipped(axis, v), u) == pytest.approx((xs[-1], after), abs=1e-12)


@given(AXES, SPEEDS)
def test_braking_is_full_until_a_hold_ends_at_rest_and_never_turns_back(axis, v):
    v = of.clipped(axis, v)
    for _ in range(5000):
        if abs(v) <= 1e-12:
            return
        u = of.brake(axis, v)
        _, after = held(axis, 0.0, v, u)
        assert np.sign(v) * after >= -1e-12
        assert u in (axis.low, axis.high) or abs(after) <= 1e-12
        v = after
    raise AssertionError("did not come to rest")


BOTH = (
    of.damped_axis(0.98, 0.04, 0.01, 4, -1.0, 1.0),
    of.damped_axis(1.0, 0.05, 0.02, 3, -0.7, 1.3),  # no damping, and stronger one way than the other
)
CONTROLS = np.array([(0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.3), (0.5, -0.7)])
GOING = np.array([0, 1, 5, 9, 20])
"""For how many control steps."""
INSTANTS = np.arange(0, 41, 2)
PAIRS = st.tuples(st.floats(-6.0, 6.0), st.floats(-6.0, 6.0)).map(np.array)


@given(PAIRS, PAIRS)
def test_every_way_is_the_manoeuvre_played(position, velocity):
    found = ways(BOTH, position, velocity, CONTROLS, GOING, INSTANTS)
    for m, i in np.ndindex(len(GOING), 2):
        axis, places, v = BOTH[i], [position[i]], velocity[i]
        for k in range(INSTANTS[-1]):
            xs, v = held(axis, places[-1], v, CONTROLS[m, i] if k < GOING[m] else to_rest(axis, v))
            places.append(xs[-1])
        np.testing.assert_allclose(found[m, :, i], np.array(places)[INSTANTS], rtol=0, atol=1e-9)


def scene(rng, boxes, discs, planes, instants=6):
    """What is around a machine near the origin."""
    centers, halves = rng.uniform(-2, 2, (instants, boxes, 2)), rng.uniform(0, 0.5, (instants, boxes, 2))
    rows = np.column_stack([rng.uniform(-2, 2, (discs, 2)), rng.uniform(0.1, 0.4, discs)])
    angles = rng.uniform(-np.pi, np.pi, planes)
    normals = np.column_stack([np.cos(angles), np.sin(angles)])
    walls = np.column_stack([-normals * rng.uniform(0.5, 3, (planes, 1)), normals, np.full(planes, 0.1)])
    return Around(centers, halves, rng.uniform(0.1, 0.3, boxes), rows, walls)


def by_points(x, y, around):
    """Clearances from each box, disc and plane, shape (obstacles, m, k)."""
    found = []
    for i, size in enumerate(around.sizes):
        (cx, cy), (hx, hy) = around.centers[:, i].T, around.halves[:, i].T
        found.append(np.hypot(np.maximum(abs(x - cx) - hx, 0), np.maximum(abs(y - cy) - hy, 0)) - size)
    found += [np.hypot(x - a, y - b) - size for a, b, size in around.discs]
    found += [(x - a) * n + (y - b) * m - size for a, b, n, m, size in around.planes]
    return np.array(found)


@given(st.integers(0, 2**31), st.tuples(*[st.integers(0, 3)] * 3))
def test_the_nearest_of_all_counts_at_the_worst_instant_and_no_number_is_not_clear(seed, counts):
    rng = np.random.default_rng(seed)
    around, places, wanted = scene(rng, *counts), rng.uniform(-1.5, 1.5, (4, 6, 2)), rng.uniform(0.0, 0.3, 6)
    lost = places.copy()
    lost[1, 2, 0] = np.nan
    if not sum(counts):
        assert np.isposinf(least_left(lost, around, wanted)).all()
        return
    expected = (by_points(places[..., 0], places[..., 1], around).min(axis=0) - wanted).min(axis=-1)
    np.testing.assert_allclose(least_left(places, around, wanted), expected, rtol=0, atol=1e-12)
    expected[1] = np.nan
    np.testing.assert_allclose(least_left(lost, around, wanted), expected, rtol=0, atol=1e-12)
