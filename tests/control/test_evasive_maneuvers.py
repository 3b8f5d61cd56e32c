"""Evasive manoeuvres against the manoeuvre played hold by hold, physics step by physics step."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.control.backup.damped_axis import damped_axis
from safe_wrappers.control.backup.evasive_maneuvers import Around, least_left, ways

AXES = (
    damped_axis(0.98, 0.04, 0.01, 4, -1.0, 1.0),
    damped_axis(1.0, 0.05, 0.02, 3, -0.7, 1.3),  # no damping, and stronger one way than the other
)
BANK = [(0.0, 0.0, 0), (1.0, 0.0, 1), (-1.0, 0.0, 5), (0.0, 1.3, 9), (0.5, -0.7, 20)]
"""Controls along x and y, and for how many control steps."""
INSTANTS = np.arange(0, 41, 2)


def substeps(axis, x, v, control):
    for _ in range(axis.substeps):
        v = axis.decay * v + axis.gain * control
        x += axis.timestep * v
    return x, v


def played(axis, x, v, force, going, holds):
    """Positions after every hold: some force, then the brake, in its last hold just to rest."""
    xs = [x]
    for k in range(holds):
        if k < going:
            control = force
        else:  # the control that ends the hold at rest, as far as the axis has it
            (_, free), (_, pushed) = substeps(axis, 0.0, v, 0.0), substeps(axis, 0.0, 0.0, 1.0)
            control = float(np.clip(-free / pushed, axis.low, axis.high))
        x, v = substeps(axis, x, v, control)
        xs.append(x)
    return xs


speed = st.floats(-6.0, 6.0)


@given(position=st.tuples(speed, speed), velocity=st.tuples(speed, speed))
def test_every_way_is_the_manoeuvre_played(position, velocity):
    *controls, going = (np.array(part) for part in zip(*BANK, strict=True))
    found = ways(AXES, np.array(position), np.array(velocity), np.stack(controls, axis=1), going, INSTANTS)
    for m, (*forces, holds) in enumerate(BANK):
        for i, axis in enumerate(AXES):
            xs = played(axis, position[i], velocity[i], forces[i], holds, int(INSTANTS[-1]))
            np.testing.assert_allclose(found[m, :, i], np.array(xs)[INSTANTS], rtol=0, atol=1e-9)


# Clearances of ways against distances computed point by point, by NumPy


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


@pytest.mark.parametrize("seed", range(20))
def test_the_nearest_of_all_counts_at_the_worst_instant(seed):
    rng = np.random.default_rng(seed)
    around = scene(rng, *rng.integers(0, 4, 2), planes=1 + seed % 3)
    places = rng.uniform(-1.5, 1.5, (4, 6, 2))
    wanted = rng.uniform(0.0, 0.3, 6)
    found = least_left(places, around, wanted)
    expected = (by_points(places[..., 0], places[..., 1], around).min(axis=0) - wanted).min(axis=-1)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_no_number_is_not_clear():
    around = scene(np.random.default_rng(0), 2, 2, 1)
    places = np.zeros((2, 6, 2))
    places[1, 2, 0] = np.nan
    left = least_left(places, around, np.zeros(6))
    assert np.isfinite(left[0]) and np.isnan(left[1])
