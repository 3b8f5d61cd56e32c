"""Evasive manoeuvres against the manoeuvre played hold by hold, physics step by physics step."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.control.backup.damped_axis import damped_axis
from safe_wrappers.control.backup.evasive_maneuvers import (
    Around,
    EvasiveManeuvers,
    Maneuver,
    least_left,
)

AXES = (
    damped_axis(0.98, 0.04, 0.01, 4, -1.0, 1.0),
    damped_axis(1.0, 0.05, 0.02, 3, -0.7, 1.3),  # no damping, and stronger one way than the other
)
BANK = [
    Maneuver(0.0, 0.0, 0),
    Maneuver(1.0, 0.0, 1),
    Maneuver(-1.0, 0.0, 5),
    Maneuver(0.0, 1.0, 9),
    Maneuver(0.5, -1.0, 20),
]
INSTANTS = np.arange(0, 41, 2)


def substeps(axis, x, v, control):
    for _ in range(axis.substeps):
        v = axis.decay * v + axis.gain * control
        x += axis.timestep * v
    return x, v


def played(axis, x, v, share, going, holds):
    """Positions after every hold: full force, then the brake, in its last hold just to rest."""
    force = share * (axis.high if share > 0 else -axis.low)
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


@given(position=st.tuples(speed, speed), velocities=st.lists(st.tuples(speed, speed), min_size=1, max_size=4))
def test_every_way_is_the_manoeuvre_played(position, velocities):
    bank = EvasiveManeuvers(AXES, BANK, INSTANTS)
    velocity = np.array(velocities)
    which = np.array([4, 0, 2, 3])
    starts = np.broadcast_to(np.array(position), velocity.shape)
    ways = bank.paths(starts, velocity, which)
    for i, axis in enumerate(AXES):
        for c, v in enumerate(velocity[:, i]):
            for row, m in enumerate(which):
                xs = played(axis, position[i], float(v), BANK[m][i], BANK[m].holds, int(INSTANTS[-1]))
                np.testing.assert_allclose(ways[i][c, row], np.array(xs)[INSTANTS], rtol=0, atol=1e-9)


@pytest.mark.parametrize("m", range(len(BANK)))
def test_the_first_control_begins_the_manoeuvre(m):
    bank = EvasiveManeuvers(AXES, BANK, np.arange(0, 41))
    velocity = np.array([1.1, -0.4])
    control = bank.first(m, velocity)
    for i, axis in enumerate(AXES):
        after = substeps(axis, 0.3, velocity[i], control[i])[0]
        way = bank.paths(np.array([[0.3, 0.3]]), velocity[None], np.array([m]))[i][0, 0]
        assert after == pytest.approx(way[1], abs=1e-12)
    assert (np.abs(control) <= [1.0, 1.3]).all() and control[1] >= -0.7


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
    """Clearances from each box, disc and plane, shape (obstacles, c, m, k)."""
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
    x, y = rng.uniform(-1.5, 1.5, (2, 3, 4, 6))
    wanted = rng.uniform(0.0, 0.3, 6)
    found = least_left(x, y, around, wanted)
    expected = (by_points(x, y, around).min(axis=0) - wanted).min(axis=-1)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_no_number_is_not_clear():
    around = scene(np.random.default_rng(0), 2, 2, 1)
    x, y = np.zeros((2, 1, 2, 6))
    x[0, 1, 2] = np.nan
    left = least_left(x, y, around, np.zeros(6))
    assert np.isfinite(left[0, 0]) and np.isnan(left[0, 1])
