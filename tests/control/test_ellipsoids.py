"""Distances to ellipsoids against the nearest point of the boundary, searched for, and against closed cases."""

from decimal import Decimal, localcontext

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from safe_wrappers.control.estimation.ellipsoids import ellipsoid_gap
from safe_wrappers.errors import ConfigurationError

LOST_WIDTH = (
    5e-8  # of the longest half-axis: what rounding takes from a singular shape's width, as documented
)

DIMENSIONS = st.sampled_from([2, 3])
HALF_AXES = st.one_of(st.just(0.0), st.floats(1e-3, 5.0))
COORDINATES = st.floats(-6.0, 6.0).map(lambda x: round(x, 6))


def turn(d, angles):
    if d == 3:
        return Rotation.from_rotvec(angles).as_matrix()
    c, s = np.cos(angles[0]), np.sin(angles[0])
    return np.array([[c, -s], [s, c]])


def one(point, shape):
    distance, normal = ellipsoid_gap(np.asarray(point, float)[None], np.asarray(shape, float)[None])
    return distance[0], normal[0]


@st.composite
def cases(draw, axes=HALF_AXES):
    d = draw(DIMENSIONS)
    half = np.array([draw(axes) for _ in range(d)])
    basis = turn(d, draw(arrays(np.float64, 3, elements=st.floats(-3.0, 3.0))))
    point = draw(arrays(np.float64, d, elements=COORDINATES))
    return point, basis @ np.diag(half**2) @ basis.T, half, basis


def searched_distance(point, half):
    """In the plane, axes along x and y: nearest point of the boundary, by the roots of the slope over its angle."""

    def away(angle):
        return np.hypot(half[0] * np.cos(angle) - point[0], half[1] * np.sin(angle) - point[1])

    def slope(angle):
        c, s = np.cos(angle), np.sin(angle)
        return (half[1] * s - point[1]) * half[1] * c - (half[0] * c - point[0]) * half[0] * s

    angles = np.linspace(0.0, 2 * np.pi, 2001)
    turns = np.flatnonzero(np.diff(np.sign(slope(angles))) > 0)
    minima = [brentq(slope, angles[i], angles[i + 1], xtol=1e-15) for i in turns]
    nearest = min([away(angles).min(), *(away(angle) for angle in minima)])
    return -nearest if (point / half) @ (point / half) < 1.0 else nearest


@given(
    arrays(np.float64, 2, elements=st.floats(0.01, 4.0)),
    arrays(np.float64, 2, elements=COORDINATES),
)
def test_the_distance_is_that_to_the_nearest_point_of_the_boundary(half, point):
    distance, _ = one(point, np.diag(half**2))
    assert distance == pytest.approx(searched_distance(point, half), abs=1e-9)


@given(cases(), st.integers(0, 2**32 - 1))
def test_no_point_of_the_set_is_nearer_and_no_point_outside_is_reached_sooner(case, seed):
    """Outside, any point of the set bounds the distance from above; inside, the ball of that depth stays inside."""
    point, shape, half, basis = case
    d = len(point)
    distance, normal = one(point, shape)
    assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-12)
    units = np.random.default_rng(seed).normal(size=(2000, d))
    units /= np.linalg.norm(units, axis=1, keepdims=True)
    if distance > 0.0:
        members = units * half @ basis.T
        assert distance <= np.linalg.norm(members - point, axis=1).min() + 1e-9
        # The foot of the normal belongs to the set: the distance is reached, not only bounded.
        foot = basis.T @ (point - distance * normal)
        slack = LOST_WIDTH * max(half)
        assert np.linalg.norm(foot / np.maximum(half, slack + 1e-12)) <= 1.0 + 1e-6
    else:
        supports = np.linalg.norm((units @ basis) * half, axis=1)
        assert (units @ point - supports).max() <= distance + LOST_WIDTH * max(half) + 1e-9


@given(cases(), arrays(np.float64, 3, elements=st.floats(-1e-4, 1e-4)))
def test_a_step_changes_the_distance_by_its_part_along_the_normal(case, step):
    point, shape, half, _ = case
    distance, normal = one(point, shape)
    assume(distance > 0.05)
    step = step[: len(point)]
    after, _ = one(point + step, shape)
    # The distance is convex, and outside its curvature is at most one over the distance.
    change = after - distance - step @ normal
    rounding = LOST_WIDTH * max(half) + 1e-12
    assert -rounding <= change <= step @ step / distance + rounding


@pytest.mark.parametrize(
    ("point", "distance", "normal"),
    [
        ((0.5, 2.0), 2.0, (0.0, 1.0)),  # beside it
        ((3.0, 0.0), 2.0, (1.0, 0.0)),  # beyond its end
        ((4.0, -4.0), 5.0, (0.6, -0.8)),  # off its end
        ((0.5, 0.0), 0.0, None),  # on it
        ((1.0, 0.0), 0.0, None),  # on its end
        ((0.0, 0.0), 0.0, None),
    ],
)
def test_an_axis_aligned_segment_from_minus_one_to_one_is_exact(point, distance, normal):
    found, direction = one(point, np.diag([1.0, 0.0]))
    assert found == pytest.approx(distance, abs=1e-15)
    if normal is None:
        assert abs(direction[1]) == 1.0, "across the segment"
    else:
        np.testing.assert_allclose(direction, normal, atol=1e-9)


def smallest_eigenvalue(a, b, c):
    """Of [[a, b], [b, c]], or zero, in 60 digits."""
    with localcontext(prec=60):
        return max((a + c - ((a - c) ** 2 + 4 * b * b).sqrt()) / 2, Decimal(0))


def test_the_width_that_rounding_hides_is_not_left_out():
    """Shapes of almost no width at any angle, against the width of the very same numbers in 60 digits."""
    rng = np.random.default_rng(5)
    hidden = 0.0
    for angle, thin in zip(rng.uniform(0.0, np.pi, 300), 10.0 ** rng.uniform(-10, -7, 300), strict=True):
        basis = turn(2, [angle])
        shape = basis @ np.diag([4.0, thin**2]) @ basis.T
        shape[1, 0] = shape[0, 1]
        a, b, c = Decimal(shape[0, 0]), Decimal(shape[0, 1]), Decimal(shape[1, 1])
        width = float(smallest_eigenvalue(a, b, c).sqrt())
        distance, _ = one(np.zeros(2), shape)
        assert distance <= -width
        assert distance >= -width - 2.0 * LOST_WIDTH
        hidden = max(hidden, width - np.sqrt(max(np.linalg.eigvalsh(shape)[0], 0.0)))
    assert hidden > 1e-9, "no width was lost: the test would not see its overestimation"


def test_extreme_ratios_stay_finite_and_bounded():
    """Half-axes over 12 decades, coordinates over 20: against the bound that every direction gives."""
    rng = np.random.default_rng(3)
    for d in (2, 3):
        half = 10.0 ** rng.uniform(-10, 2, (2000, d))
        points = 10.0 ** rng.uniform(-18, 2, (2000, d)) * rng.choice([-1.0, 0.0, 1.0], (2000, d))
        distance, normal = ellipsoid_gap(points, half[:, :, None] ** 2 * np.eye(d))
        np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-12)
        units = rng.normal(size=(200, 1, d))
        units /= np.linalg.norm(units, axis=2, keepdims=True)
        bounds = (units * points).sum(axis=2) - np.linalg.norm(units * half, axis=2)
        assert (bounds.max(axis=0) <= distance + 1e-11 * (1.0 + half.max(axis=1))).all()


@pytest.mark.parametrize(
    ("offset", "shape", "words"),
    [
        (np.array([[np.nan, 0.0]]), np.zeros((1, 2, 2)), "finite"),
        (np.zeros((1, 2)), np.full((1, 2, 2), np.inf), "finite"),
    ],
)
def test_bad_input_is_refused(offset, shape, words):
    with pytest.raises(ConfigurationError, match=words):
        ellipsoid_gap(offset, shape)
