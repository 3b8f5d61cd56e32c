"""Observability against exact ranks of integer systems, python-control, the PBH test and systems known by hand."""

from fractions import Fraction

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import subspace_angles

from safe_wrappers.control.estimation.lie_derivatives import nonlinear_observability
from safe_wrappers.control.estimation.observability import (
    TOLERANCE,
    described,
    described_subspace,
    scale_system,
    unobservable_directions,
    unobservable_subspace,
)
from safe_wrappers.errors import ConfigurationError

SIZES = st.integers(1, 5)
SMALL = st.integers(-2, 2).map(float)


@st.composite
def integer_systems(draw):
    """Many of them unobservable: sparse, with small entries, often one state that nothing shows."""
    n, m = draw(SIZES), draw(st.integers(1, 2))
    a = draw(arrays(np.float64, (n, n), elements=SMALL)) * draw(
        arrays(np.float64, (n, n), elements=st.sampled_from([0.0, 1.0]))
    )
    c = draw(arrays(np.float64, (m, n), elements=SMALL))
    if n > 1 and draw(st.booleans()):
        hidden = draw(st.integers(0, n - 1))
        a[np.arange(n) != hidden, hidden] = 0.0
        c[:, hidden] = 0.0
    return a, c


def exact_rank(a, c):
    """Of the observability matrix, in fractions."""
    block, rows = [[Fraction(int(v)) for v in row] for row in c], []
    for _ in range(len(a)):
        rows += [list(row) for row in block]
        block = [[sum(row[k] * int(a[k, j]) for k in range(len(a))) for j in range(len(a))] for row in block]
    rank = 0
    for column in range(len(a)):
        pivot = next((i for i in range(rank, len(rows)) if rows[i][column]), None)
        if pivot is None:
            continue
        rows[rank], rows[pivot] = rows[pivot], rows[rank]
        for i in range(rank + 1, len(rows)):
            factor = rows[i][column] / rows[rank][column]
            rows[i] = [v - factor * w for v, w in zip(rows[i], rows[rank], strict=True)]
        rank += 1
    return rank


def transform(n, seed):
    """A change of coordinates that is far from singular."""
    rng = np.random.default_rng(seed)
    left, _ = np.linalg.qr(rng.normal(size=(n, n)))
    right, _ = np.linalg.qr(rng.normal(size=(n, n)))
    return left @ np.diag(rng.uniform(0.3, 3.0, n)) @ right


def same_space(one, other):
    assert one.shape == other.shape
    if one.shape[1]:
        assert subspace_angles(one, other).max() < 1e-6


# Linear


def unobservable(a, c):
    """Orthonormal basis, shape (n, n - rank)."""
    return unobservable_subspace(scale_system(np.asarray(a, float), np.asarray(c, float)), TOLERANCE)


def rank(a, c):
    return len(a) - unobservable(a, c).shape[1]


@given(integer_systems())
def test_the_rank_is_the_exact_one_and_the_basis_is_in_the_kernel(system):
    a, c = system
    n, basis = len(a), unobservable(a, c)
    hidden = n - exact_rank(a, c)
    assert basis.shape == (n, hidden)
    np.testing.assert_allclose(basis.T @ basis, np.eye(hidden), atol=1e-12)
    np.testing.assert_allclose(control.obsv(a, c) @ basis, 0.0, atol=1e-9 * 20.0**n)
    assert len(unobservable_directions(a, c)) == hidden


@given(integer_systems(), st.integers(0, 2**32 - 1))
def test_other_coordinates_have_the_same_rank_and_the_same_kernel(system, seed):
    a, c = system
    t = transform(len(a), seed)
    back = np.linalg.inv(t)
    mapped, _ = np.linalg.qr(t @ unobservable(a, c))
    same_space(unobservable(t @ a @ back, c @ back), mapped)


@given(integer_systems(), st.data())
def test_units_do_not_decide(system, data):
    """Seconds or years, metres or micrometres, an amplifier behind a sensor."""
    a, c = system
    n = len(a)
    powers = st.integers(-3, 3)
    units = 10.0 ** np.array(data.draw(st.lists(powers, min_size=n, max_size=n)), dtype=float)
    gains = 10.0 ** np.array(data.draw(st.lists(powers, min_size=len(c), max_size=len(c))), dtype=float)
    second = 10.0 ** float(data.draw(st.integers(-5, 12)))
    assert rank(second * a * units / units[:, None], gains[:, None] * c * units) == exact_rank(a, c)
    assert unobservable_directions(second * a, c) == unobservable_directions(a, c)


def test_a_stiff_spring_is_seen_from_its_position():
    """1e6 rad/s: without scaling, position and velocity are 1e12 apart."""
    a = [[0.0, 1.0], [-1e12, -1.0]]
    assert rank(a, [[1.0, 0.0]]) == rank(a, [[0.0, 1.0]]) == 2


def test_a_long_chain_of_integrators_is_seen_from_its_end_only():
    a = np.diag(np.ones(11), 1)
    assert unobservable_directions(a, np.eye(12)[:1]) == ()
    assert unobservable_directions(a, np.eye(12)[-1:]) == tuple(f"x{i}" for i in range(11))


def test_fast_and_slow_modes_side_by_side():
    """Powers of A up to 1e3^7: a rank of the plain matrix loses the slow ones."""
    a, c = np.diag([1e-3, -2e-3, 0.3, -0.7, 11.0, -13.0, 500.0, 1000.0]), np.ones((1, 8))
    assert np.linalg.matrix_rank(control.obsv(a, c)) < 8
    assert rank(a, c) == 8


POSITION_VELOCITY = np.kron([[0.0, 1.0], [0.0, 0.0]], np.eye(2))
PLANE = ("x", "y", "vx", "vy")


@pytest.mark.parametrize(
    ("c", "names"),
    [
        ([[1, 0, 0, 0], [0, 1, 0, 0]], ()),
        ([[0, 0, 1, 0], [0, 0, 0, 1]], ("x", "y")),
        ([[1, 0, 0, 0]], ("y", "vy")),
        ([[0, 0, 0, 0]], PLANE),
        ([[1, -1, 0, 0]], ("x + y", "vx + vy")),
        ([[0.6, -0.8, 0, 0]], ("x + 0.75 y", "vx + 0.75 vy")),
        ([[0, 0, 1, 0]], ("x", "y", "vy")),
    ],
)
def test_what_is_not_seen_of_a_point_in_the_plane_is_named(c, names):
    assert unobservable_directions(POSITION_VELOCITY, c, PLANE) == names


def test_an_outputs_gain_does_not_matter():
    assert rank(np.zeros((2, 2)), [[1, 0], [0, 1e-25]]) == 2


def test_a_weak_coupling_is_a_matter_of_units_but_rounding_is_none():
    a = np.diag([-1.0, -1.0])
    a[0, 1] = 1e-10
    assert rank(a, [[1, 0]]) == rank(np.diag([0.0, -1.0]), [[1, 1e-12]]) == 2
    a[0, 1] = 1e-15
    assert unobservable_directions(a, [[1, 0]], names=("p", "q")) == ("q",)


# Names


@pytest.mark.parametrize(
    ("direction", "text"),
    [
        ([1.0, 0.0, 0.0], "x"),
        ([0.0, -2.0, 0.0], "y"),
        ([0.8, 0.6, 0.0], "0.8 x + 0.6 y"),
        ([-0.7071, 0.7071, 0.0], "x - y"),
        ([1.0, 1e-12, -0.5], "x - 0.5 z"),
        ([0.0, 1.0, 12345.0], "y + 1.23e+04 z"),
        ([-1.0, 1.0, 1.0], "x - y - z"),
    ],
)
def test_a_direction_is_written_in_the_states_names(direction, text):
    assert described(direction, ("x", "y", "z")) == text


@given(st.sets(st.integers(0, 5), min_size=1, max_size=5), st.integers(0, 2**32 - 1))
def test_a_rotated_basis_of_single_states_is_shown_as_these_states(states, seed):
    chosen = sorted(states)
    basis = np.eye(6)[:, chosen] @ transform(len(chosen), seed)
    assert described_subspace(basis, list("abcdef")) == tuple("abcdef"[i] for i in chosen)


def test_each_direction_has_the_coefficient_one_for_the_first_state_that_will_do():
    def shown(*columns):
        return described_subspace(np.array(columns).T, ("x", "y", "z"))

    assert shown([0.6, 0.8, 0.0]) == ("x + 1.33 y",)
    assert shown([0.05, 1.0, 0.0]) == ("0.05 x + y",)
    assert shown([0.01, 1.0, 0.0], [0.02, 1.0, 0.0]) == ("x", "y")
    assert shown([1.0, 1.0, 0.5], [1.0, -1.0, 0.5]) == ("x + 0.5 z", "y")


# Nonlinear


def ranging(velocity, names=("x", "y"), at=(3.0, 4.0), beacon=(0.0, 0.0), **options):
    """A robot that knows its velocity and measures its distance to a beacon whose place is known."""
    return nonlinear_observability(
        lambda x: np.array(velocity),
        lambda x: [np.hypot(x[0] - beacon[0], x[1] - beacon[1])],
        at,
        names,
        **options,
    )


@given(integer_systems())
def test_of_a_linear_system_it_says_what_the_linear_test_says(system):
    a, c = system
    found = nonlinear_observability(lambda x: a @ x, lambda x: c @ x, np.linspace(1.0, 2.0, len(a)))
    assert found.rank == rank(a, c)
    same_space(found.unobservable, unobservable(a, c))


def test_a_range_alone_at_rest_leaves_the_tangent_and_motion_takes_it_away():
    still = ranging((0.0, 0.0))
    assert still.rank == 1
    assert still.names == ("x - 0.75 y",)
    np.testing.assert_allclose(np.abs(still.unobservable[:, 0]), [0.8, 0.6], atol=1e-12)
    assert still.rank_by_order == (1,) * 5
    moving = ranging((1.0, 0.0))
    assert moving.observable
    assert moving.names == ()
    assert moving.rank_by_order == (1, 2, 2, 2, 2)
    assert moving.gap > 1e6


def test_moving_along_the_line_of_sight_does_not_help():
    assert ranging((0.6, 0.8)).names == ("x - 0.75 y",)


def test_the_tangent_is_named_wherever_the_beacon_is():
    found = ranging((0.0, 0.0), at=(2.0, 5.0), beacon=(2.0, 1.0))
    assert found.names == ("x",)
    assert ranging((0.0, 0.0), at=(0.0, 1.0), beacon=(1.0, 0.0)).names == ("x + y",)


@given(st.floats(0.1, 6.2), st.floats(0.5, 50.0), st.floats(0.05, 3.0), st.floats(0.2, 2.9))
def test_any_motion_across_the_line_of_sight_will_do(bearing, distance, speed, across):
    """And the basis at rest is the tangent, whatever the scales."""
    at = distance * np.array([np.cos(bearing), np.sin(bearing)])
    heading = bearing + across
    assert ranging(speed * np.array([np.cos(heading), np.sin(heading)]), at=at).observable
    tangent = ranging((0.0, 0.0), at=at).unobservable[:, 0]
    assert abs(tangent @ at) < 1e-9 * distance


def test_the_side_of_the_beacon_is_not_told_but_that_is_not_near():
    """Mirrored at the track, every distance is the same for ever, though each side alone is locally observable."""
    t = np.linspace(0.0, 10.0, 50)
    np.testing.assert_array_equal(np.hypot(3.0 + t, 4.0), np.hypot(3.0 + t, -4.0))
    for side in (4.0, -4.0):
        assert ranging((1.0, 0.0), at=(3.0, side)).observable


def pursuit(acceleration):
    """A target of unknown constant velocity, relative to a sensor that measures its range."""
    return nonlinear_observability(
        lambda x: [x[2], x[3], -acceleration[0], -acceleration[1]],
        lambda x: [np.hypot(x[0], x[1])],
        [3.0, 4.0, 1.0, 0.5],
        ("x", "y", "vx", "vy"),
    )


def test_ranging_a_moving_target_needs_a_sensor_that_accelerates():
    """Turning position and velocity together about the sensor changes no range, unless the acceleration stays."""
    coasting = pursuit((0.0, 0.0))
    assert coasting.rank == 3
    turning = np.array([-4.0, 3.0, -0.5, 1.0])
    same_space(coasting.unobservable, turning[:, None] / np.linalg.norm(turning))
    assert pursuit((0.2, 0.1)).observable


def test_bearings_of_a_moving_target_leave_its_scale():
    """Twice as far and twice as fast looks the same."""
    at = [3.0, 4.0, 1.0, -0.5]
    found = nonlinear_observability(
        lambda x: [x[2], x[3], 0, 0], lambda x: [np.arctan2(x[1], x[0])], at, ("x", "y", "vx", "vy")
    )
    assert found.rank == 3
    same_space(found.unobservable, np.array(at)[:, None] / np.linalg.norm(at))


def test_a_distance_between_two_robots_leaves_where_they_are_together():
    found = nonlinear_observability(
        lambda x: [0.3, 0.0, -0.2, 0.5],
        lambda x: [np.linalg.norm(x[:2] - x[2:])],
        [0.0, 0.0, 2.0, 1.0],
        ("ax", "ay", "bx", "by"),
    )
    assert found.names == ("ax + bx", "ay + by")


def test_a_heading_shows_only_in_motion():
    def unicycle(speed):
        return nonlinear_observability(
            lambda x: [speed * np.cos(x[2]), speed * np.sin(x[2]), 0.0],
            lambda x: [x[0], x[1]],
            [1.0, 2.0, 0.4],
            ("x", "y", "heading"),
        )

    assert unicycle(0.0).names == ("heading",)
    assert unicycle(0.5).observable


def test_the_rank_may_stall_and_grow_later():
    """y = x³ at x = 0: the first two differentials vanish, so a test that stops where it stalls would be wrong."""
    assert nonlinear_observability(lambda x: [1.0], lambda x: [x[0] ** 3], [0.0]).rank_by_order == (0, 0, 1)
    assert nonlinear_observability(lambda x: [1.0], lambda x: [x[0] ** 3], [0.0], order=1).rank == 0


def test_the_order_is_twice_the_number_of_states_unless_given():
    """y = x^5 at 0 needs four: more than 2 n."""
    assert nonlinear_observability(lambda x: [1.0], lambda x: [x[0] ** 5], [0.0]).rank_by_order == (0, 0, 0)
    assert nonlinear_observability(lambda x: [1.0], lambda x: [x[0] ** 5], [0.0], order=4).rank == 1


def test_rounding_is_not_taken_for_information():
    """cos(x) has no slope at pi, though its sine comes out as 1e-16; nor does a pendulum at rest there show it."""
    found = nonlinear_observability(
        lambda x: [x[1], 0.0], lambda x: [np.cos(x[0])], [np.pi, 0.0], ("angle", "rate")
    )
    assert found.rank == 0
    assert found.names == ("angle", "rate")
    assert np.isinf(found.condition)
    heading = nonlinear_observability(
        lambda x: [np.cos(x[2]), 0.0, 0.0], lambda x: [np.hypot(x[0], x[1])], [0.0, 4.0, np.pi / 2]
    )
    assert "x0" in heading.names[0]


def test_a_state_in_large_units_is_not_overlooked():
    """Of a share of 3e-11 in the output, a factor of 1,000 is put down to its units."""
    found = nonlinear_observability(lambda x: [x[0], 2.0 * x[1]], lambda x: [x[0] + 3e-11 * x[1]], [1.0, 1.0])
    assert found.observable


def test_a_weak_first_order_does_not_spoil_the_time_scale():
    """cos(x) has nearly no slope near pi; how fast it changes is told by the orders that follow."""
    found = nonlinear_observability(lambda x: [x[1], 0.0], lambda x: [np.cos(x[0])], [np.pi - 1e-7, 1.0])
    assert found.rank_by_order[1:3] == (1, 2)


@given(st.lists(st.integers(-2, 2), min_size=4, max_size=4), st.integers(-5, 6), st.integers(-3, 3))
def test_units_do_not_decide_either(powers, second, gain):
    units, rate, gain = 10.0 ** np.array(powers, float), 10.0**second, 10.0**gain

    def f(x):
        return rate * np.array([x[2] / units[2], x[3] / units[3], 0, 0]) * units

    def h(x):
        return [gain * np.hypot(x[0] / units[0], x[1] / units[1])]

    found = nonlinear_observability(f, h, units * [3.0, 4.0, 1.0, 0.5])
    assert found.rank == 3
    direction = units * [-4.0, 3.0, -0.5, 1.0]
    same_space(found.unobservable, direction[:, None] / np.linalg.norm(direction))


@given(st.integers(0, 2**32 - 1))
def test_other_coordinates_of_a_nonlinear_system(seed):
    t = transform(4, seed)
    back = np.linalg.inv(t)

    def f(z):
        x = back @ z
        return t @ np.array([x[2], x[3], 0.0, 0.0])

    found = nonlinear_observability(f, lambda z: [np.hypot(*(back @ z)[:2])], t @ [3.0, 4.0, 1.0, 0.5])
    assert found.rank == 3
    direction = t @ [-4.0, 3.0, -0.5, 1.0]
    same_space(found.unobservable, direction[:, None] / np.linalg.norm(direction))


def test_a_rank_on_the_edge_says_so_in_nonlinear_systems_too():
    """Nearly along the line of sight."""
    near = ranging((0.6, 0.8 + 3e-9))
    assert near.gap < 100.0
    assert ranging((0.6, 0.8 + 3e-9), tolerance=1e-6).rank == 1


# Bad input


@pytest.mark.parametrize(
    ("a", "c", "options", "words"),
    [
        (np.zeros((2, 3)), np.zeros((1, 2)), {}, r"A must be square, of shape \(n, n\), got \(2, 3\)"),
        (np.zeros((0, 0)), np.zeros((1, 0)), {}, "A must be square"),
        (np.eye(2), np.zeros((1, 3)), {}, r"shape \(m, 2\) for this A, got \(1, 3\)"),
        (np.eye(2), np.zeros(2), {}, r"got \(2,\)"),
        (np.eye(2), np.zeros((0, 2)), {}, "a row for each output"),
        (np.full((2, 2), np.nan), np.zeros((1, 2)), {}, "A must be finite"),
        (np.eye(2), [[np.inf, 0.0]], {}, "C must be finite"),
        (np.eye(2), [["a", "b"]], {}, "C is a number or an array of numbers"),
        (np.eye(2), np.eye(2), {"names": ("x",)}, "each of the 2 states, got"),
        (np.eye(2), np.eye(2), {"names": ("x", "x")}, "a name of its own"),
        (np.eye(2), np.eye(2), {"names": "xy"}, "a name of its own"),
    ],
)
def test_bad_linear_input_is_refused(a, c, options, words):
    with pytest.raises(ConfigurationError, match=words):
        unobservable_directions(a, c, **options)


@pytest.mark.parametrize(
    ("x", "options", "words"),
    [
        ([[1.0, 2.0]], {}, r"of shape \(n,\), got shape \(1, 2\)"),
        ([1.0, np.nan], {}, "x must be finite"),
        ([], {}, "expected a vector"),
        ([1.0, 2.0], {"names": ("x", "y", "z")}, "each of the 2 states"),
        ([1.0, 2.0], {"order": -1}, "must not be negative, got -1"),
        ([1.0, 2.0], {"tolerance": 1.0}, "between 0 and 1"),
        ([0.0, 0.0], {}, "not differentiable"),
    ],
)
def test_bad_nonlinear_input_is_refused(x, options, words):
    with pytest.raises(ConfigurationError, match=words):
        nonlinear_observability(lambda x: 0 * x, lambda x: [np.hypot(x[0], x[1])], x, **options)


@pytest.mark.parametrize("direction", [[0.0, 0.0], [np.nan, 1.0], [1.0], [[1.0, 0.0]]])
def test_what_is_no_direction_is_refused(direction):
    with pytest.raises(ConfigurationError):
        described(direction, ("x", "y"))
