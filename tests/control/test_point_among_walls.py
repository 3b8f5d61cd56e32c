"""Points on two axes: their ways among walls and manoeuvres against single physics steps, distances by points."""

import hashlib
import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from oracles import held, to_rest

from safe_wrappers.control.backup import point_among_walls as of
from safe_wrappers.control.backup.damped_axis import clipped, damped_axis, step
from safe_wrappers.control.backup.evasive_maneuvers import Around, least_left, ways

WALLS = [(-3.0, 3.0, -3.0, -2.0), (-3.0, 3.0, 2.0, 3.0), (-3.0, -2.0, -2.0, 2.0), (2.0, 3.0, -2.0, 2.0)]
AMONG = np.array([*WALLS, (-0.5, 0.5, -0.5, 0.4), (0.9, 1.2, -0.1, 0.9)])
CLIP = 5.0


def axes(substeps=1, clip=CLIP):
    x_axis = damped_axis(0.998, 0.24 / substeps, 0.01, substeps, -1.0, 1.0, clip)
    return x_axis, damped_axis(0.99, 0.2 / substeps, 0.01, substeps, -0.7, 0.9, clip)


def played(axis, x, v, controls):
    """The way along one axis until rest."""
    xs, controls = [x], list(controls)
    while controls or abs(v) > 1e-12:
        more, v = held(axis, xs[-1], v, controls.pop(0) if controls else to_rest(axis, v))
        xs += more
    return xs


PAIRS = st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0)).map(np.array)
SPEEDS = st.tuples(st.floats(-6.0, 6.0), st.floats(-6.0, 6.0)).map(np.array)
CONTROLS = st.lists(st.tuples(st.floats(-1.2, 1.2), st.floats(-1.2, 1.2)), max_size=2).map(
    lambda rows: np.array(rows, dtype=np.float64).reshape(-1, 2)
)


@given(PAIRS, SPEEDS, CONTROLS, st.sampled_from([1, 4]), st.sampled_from([CLIP, math.inf]))
def test_a_way_is_every_physics_step_until_rest(place, velocity, controls, substeps, clip):
    both = axes(substeps, clip)
    way = of.way(both, place, velocity, controls)
    for i, axis in enumerate(both):
        xs = np.array(played(axis, place[i], velocity[i], controls[:, i]))
        # At a whole number of control steps rounding decides whether one more, of next to nothing, ends at rest.
        n = min(len(xs), len(way))
        np.testing.assert_allclose(way[:n, i], xs[:n], rtol=0, atol=1e-9)
        np.testing.assert_allclose(way[n - 1 :, i], xs[-1], rtol=0, atol=1e-9)


def test_of_a_way_that_is_not_finite_no_distance_is_a_number():
    still, lost, holds = np.zeros(2), np.array([0.0, math.nan]), np.zeros((1, 2))
    endless = of.way(axes(clip=math.inf), still, np.array([1e9, 0.0]), holds[:0])
    fast = of.way(axes(), still, np.array([math.inf, 0.0]), holds)
    assert np.isnan(endless[-1]).tolist() == [True, False]  # the other axis came to rest
    for way in (of.way(axes(), lost, still, holds), of.way(axes(), still, lost, holds), fast, endless):
        for whole in (False, True):
            assert np.isnan(way[-1]).any() and np.isnan(of.distances(way, AMONG, whole)).all()


def from_points(points, wall):
    """Euclidean distances of points (n, 2) from a rectangle, 0 inside."""
    low, high = np.array(wall[::2]), np.array(wall[1::2])
    return np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0.0), axis=1)


NUMBERS = st.floats(-3.0, 3.0).map(lambda x: round(x, 3))
SIDES = st.lists(NUMBERS, min_size=2, max_size=2, unique=True).map(sorted)
RECTANGLES = st.builds(lambda x, y: (*x, *y), SIDES, SIDES)


@given(st.lists(st.tuples(NUMBERS, NUMBERS), min_size=2, max_size=4), RECTANGLES)
def test_distances_are_of_the_rectangles_between_positions(places, wall):
    places = np.array(places)
    found = of.distances(places, np.array([wall]), False)[:, 0]
    shares = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, 41)] * 2), axis=-1).reshape(-1, 2)
    for a, b, distance in zip(places[:-1], places[1:], found, strict=True):
        sampled = from_points(a + shares * (b - a), wall).min()
        low, high = np.minimum(a, b), np.maximum(a, b)
        if distance > 0.0:  # the samples are at most half a cell's diagonal from the nearest point
            assert distance <= sampled + 1e-12 and sampled <= distance + np.linalg.norm(b - a) / 80 + 1e-12
            continue
        # Inside: the shortest translation along an axis that separates them.
        moves = wall[1] - low[0], high[0] - wall[0], wall[3] - low[1], high[1] - wall[2]
        assert distance == pytest.approx(-min(moves), abs=1e-12)
    around, *_, end = of.distances(places, np.array([wall]), True)
    box = np.stack([places.min(axis=0), places.max(axis=0)])
    assert around == of.distances(box, np.array([wall]), False)[0]
    assert end == of.distances(places[[-1, -1]], np.array([wall]), False)[0]


@given(PAIRS, SPEEDS, PAIRS, st.sampled_from([1, 4]), st.booleans(), st.floats(0.05, 0.2))
def test_slides_keep_the_room_and_go_from_braking_towards_what_was_asked(
    place, velocity, asked, substeps, whole, room
):
    both = axes(substeps, math.inf if whole else CLIP)
    assume(of.distances(of.way(both, place, velocity, np.zeros((0, 2))), AMONG, whole).min() >= room)
    asked = np.clip(asked, [-1.0, -0.7], [1.0, 0.9])
    brakes = np.array([of.brake(a, of.clipped(a, v)) for a, v in zip(both, velocity, strict=True)])
    for control in of.slides(both, place, velocity, asked, AMONG, room, whole):
        left = of.distances(of.way(both, place, velocity, control[None]), AMONG, whole).min()
        assert left >= room or np.array_equal(control, brakes)
        assert (control >= np.minimum(brakes, asked)).all() and (control <= np.maximum(brakes, asked)).all()
        for i in range(2):  # neither axis has anything left to give
            more = control.copy()
            more[i] += 1e-5 * np.sign(asked[i] - control[i])
            if abs(asked[i] - control[i]) > 1e-5 and left >= room:
                assert of.distances(of.way(both, place, velocity, more[None]), AMONG, whole).min() < room


def random_scenes(count):
    """Every function on random scenes, as one digest."""
    rng, digest = np.random.default_rng(11), hashlib.sha256()
    for i in range(count):
        whole = not i % 3
        both = axes((1, 4)[i % 2], math.inf if whole else CLIP)
        place, velocity, asked = rng.uniform(-1.9, 1.9, 2), rng.uniform(-5.5, 5.5, 2), rng.uniform(-1, 1, 2)
        way = of.way(both, place, velocity, asked[None])
        room = rng.uniform(0.05, 0.3)
        for part in (
            way,
            of.distances(way, AMONG, whole),
            of.slides(both, place, velocity, asked, AMONG, room, whole),
        ):
            digest.update(part.tobytes())
    return digest.hexdigest()


# A held axis, evasive manoeuvres against single physics steps, and clearances of ways point by point ------------

SPEED = st.floats(-7.0, 7.0).map(lambda v: round(v, 6))
AXIS = st.builds(
    damped_axis,
    decay=st.floats(0.8, 1.0),
    gain=st.floats(0.01, 0.5),
    timestep=st.sampled_from([0.002, 0.01, 0.05]),
    substeps=st.integers(1, 6),
    low=st.floats(-2.0, -0.2),
    high=st.floats(0.2, 2.0),
    clip=st.floats(1.0, 6.0),
)


@given(AXIS, st.floats(-3.0, 3.0), SPEED, st.floats(-3.0, 3.0))
def test_a_hold_is_its_physics_steps(axis, x, v, u):
    xs, after = held(axis, x, v, u)
    assert step(axis, x, clipped(axis, v), u) == pytest.approx((xs[-1], after), abs=1e-12)


UNEVEN = (
    damped_axis(0.98, 0.04, 0.01, 4, -1.0, 1.0),
    damped_axis(1.0, 0.05, 0.02, 3, -0.7, 1.3),  # no damping, and stronger one way than the other
)
MANOEUVRES = np.array([(0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.3), (0.5, -0.7)])
GOING = np.array([0, 1, 5, 9, 20])
"""For how many control steps."""
INSTANTS = np.arange(0, 41, 2)
NEAR = st.tuples(st.floats(-6.0, 6.0), st.floats(-6.0, 6.0)).map(np.array)


@given(NEAR, NEAR)
def test_every_way_is_the_manoeuvre_played(position, velocity):
    found = ways(UNEVEN, position, velocity, MANOEUVRES, GOING, INSTANTS)
    for m, i in np.ndindex(len(GOING), 2):
        going = [MANOEUVRES[m, i]] * GOING[m]
        places = np.array(played(UNEVEN[i], position[i], velocity[i], going))[:: UNEVEN[i].substeps]
        places = np.append(places, np.full(INSTANTS[-1], places[-1]))
        np.testing.assert_allclose(found[m, :, i], places[INSTANTS], rtol=0, atol=1e-9)


def surroundings(rng, boxes, discs, planes, instants=6):
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
    around, places = surroundings(rng, *counts), rng.uniform(-1.5, 1.5, (4, 6, 2))
    wanted = rng.uniform(0.0, 0.3, 6)
    lost = places.copy()
    lost[1, 2, 0] = np.nan
    if not sum(counts):
        assert np.isposinf(least_left(lost, around, wanted)).all()
        return
    expected = (by_points(places[..., 0], places[..., 1], around).min(axis=0) - wanted).min(axis=-1)
    np.testing.assert_allclose(least_left(places, around, wanted), expected, rtol=0, atol=1e-12)
    expected[1] = np.nan
    np.testing.assert_allclose(least_left(lost, around, wanted), expected, rtol=0, atol=1e-12)
