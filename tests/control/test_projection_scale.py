"""project in any unit of the control, and on feasible sets that are thin: by LP, clarabel and exact fractions."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from scipy.optimize import linprog, lsq_linear

from safe_wrappers.control.projection import box_least_squares, keeps_rows, project
from tests.control.test_projection import clarabel

SCALES = st.floats(-12.0, 12.0).map(lambda exponent: 10.0**exponent)


def room(normals, offsets, lower, upper):
    """By how much the best control in the box keeps every row (below 0: misses one), in lengths of the normals."""
    lengths = np.linalg.norm(normals, axis=1)
    solved = linprog(
        np.append(np.zeros(normals.shape[1]), -1.0),
        A_ub=np.hstack([normals, lengths[:, None]]),
        b_ub=offsets,
        bounds=[*zip(lower, upper, strict=True), (-10.0, 10.0)],
    )
    return solved.x[-1]


@st.composite
def problems(draw):
    """Nominal, rows and a box of order one; feasible or not, some components without bounds."""
    rng = np.random.default_rng(draw(st.integers(0, 2**31)))
    size, rows = draw(st.integers(1, 4)), draw(st.integers(1, 6))
    normals = rng.normal(size=(rows, size))
    offsets = normals @ rng.uniform(-0.9, 0.9, size) + rng.normal(
        draw(st.sampled_from([0.2, -0.1])), 0.3, rows
    )
    lower, upper = -rng.uniform(0.2, 1.0, size), rng.uniform(0.2, 1.0, size)
    open_ended = rng.random(size) < draw(st.sampled_from([0.0, 0.3, 1.0]))
    return rng.uniform(-1.2, 1.2, size), normals, offsets, lower, np.where(open_ended, np.inf, upper)


@given(problems(), SCALES, st.booleans())
def test_the_unit_of_the_control_changes_nothing(problem, scale, in_the_rows):
    u, normals, offsets, lower, upper = problem
    feasible = room(normals, offsets, lower, upper)
    assume(abs(feasible) > 1e-6)  # on the edge, rounding decides
    answer = project(*problem)
    rows = (normals / scale, offsets) if in_the_rows else (normals, offsets * scale)
    other = project(u * scale, *rows, lower * scale, upper * scale)
    assert other.status == answer.status
    np.testing.assert_allclose(other.control / scale, answer.control, atol=1e-6)
    assert (answer.status == "infeasible") == (feasible < 0.0)
    if answer.status == "inactive":
        assert other.control.tobytes() == (u * scale).tobytes()
    if answer.status == "projected":
        assert keeps_rows(other.control, *rows, lower * scale, upper * scale)
        assert (
            not keeps_rows(u * scale, *rows, lower * scale, upper * scale)
            or (u > upper).any()
            or (u < lower).any()
        )
    if answer.status == "projected" and np.isfinite(upper).all():
        np.testing.assert_allclose(answer.control, clarabel(u, normals, offsets, lower, upper), atol=1e-6)


@pytest.mark.parametrize("scale", [1e-9, 1e-3, 1e3, 1e9])
@pytest.mark.parametrize("rows", [1, 2])
def test_a_nominal_on_the_boundary_to_rounding_is_inactive_in_every_unit(scale, rows):
    u, normals = np.array([0.3, 0.4]) * scale, np.array([[0.6, 0.8], [0.8, -0.6]])[:rows]
    for miss, status in ((-1e-12, "inactive"), (1e-12, "inactive"), (1e-6, "projected")):
        answer = project(u, normals, normals @ u - miss * scale, -scale, scale)
        assert answer.status == status
        assert status == "projected" or answer.control.tobytes() == u.tobytes()


@pytest.mark.parametrize("open_ended", [False, True])
@given(st.integers(0, 2**31), st.integers(2, 5), st.integers(1, 8))
def test_components_of_very_different_width(open_ended, seed, size, rows):
    # A feasible point inside: one unit for all components once left narrow ones to the solver's tolerance.
    rng = np.random.default_rng(seed)
    width = 10.0 ** rng.uniform(-4.0, 4.0, size)
    normals = rng.normal(size=(rows, size)) / width
    lengths = np.linalg.norm(normals * width, axis=1)
    offsets = normals @ (width * rng.uniform(-0.5, 0.5, size)) + lengths * rng.uniform(0.2, 1.0, rows)
    upper = np.where(np.arange(size) < open_ended, np.inf, width)
    answer = project(width * rng.uniform(-1.0, 1.0, size), normals, offsets, -width, upper)
    assert answer.status in ("inactive", "projected")
    assert keeps_rows(answer.control, normals, offsets, -width, upper)


def test_a_nominal_far_outside_of_the_box_moves_no_row():
    # A tolerance that grew with the nominal answered 1.0.
    assert project([1e9], [[1.0]], [0.5], -1.0, 1.0).control == pytest.approx([0.5])


@pytest.mark.parametrize("bound", [1e3, 1e5, 1e10, 1e20, 3.4e38, math.inf])
@pytest.mark.parametrize("rows", [1, 2])
def test_a_bound_that_is_far_away_lets_nothing_through(bound, rows):
    # A share of such a box would be more than the control itself.
    answer = project([0.9, 0.8], np.eye(2)[:rows], [0.9 - 1e-6, 0.5][:rows], -bound, bound)
    assert answer.status == "projected"
    np.testing.assert_allclose(answer.control, [0.9 - 1e-6, 0.5 if rows == 2 else 0.8], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("size", [1e200, math.nan])
def test_a_row_that_cannot_be_checked_is_not_kept(size):
    one = np.ones(1)
    assert not keeps_rows(one, np.array([[size]]), one, -one, one)


def test_an_offset_that_nothing_keeps_is_not_kept_in_a_wide_box():
    assert not keeps_rows(
        np.ones(1), np.ones((1, 1)), np.array([-math.inf]), -1e3 * np.ones(1), 1e3 * np.ones(1)
    )


def test_entries_of_very_different_size_in_one_row():
    # Two components end at a bound; the third carries the rest with a hundred-thousandth of the first's slope.
    u, slope = np.array([0.2, 0.0, -1000.0]), np.array([[640.0, -11000.0, -0.0855]])
    lower, upper = np.array([-0.1, -0.002, -900.0]), np.array([0.3, 0.0065, 990.0])
    answer = project(u, slope, [-130.0], lower, upper)
    assert answer.status == "projected"
    exact = (640.0 * -0.1 - 11000.0 * 0.0065 + 130.0) / 0.0855
    np.testing.assert_allclose(answer.control, [-0.1, 0.0065, exact], rtol=1e-9)


# Thin feasible sets -------------------------------------------------------------------------------------------


def apex(normals, offsets):
    """Where two rows meet, exactly, for the numbers as they are stored."""
    (a, b), (c, d) = [[Fraction(v) for v in row] for row in normals.tolist()]
    e, f = map(Fraction, offsets.tolist())
    determinant = a * d - b * c
    return np.array([float((e * d - b * f) / determinant), float((a * f - e * c) / determinant)])


@given(st.floats(-5.0, -1.0), st.floats(0.0, 6.28), st.floats(0.05, 0.4), st.floats(-0.3, 0.3), SCALES)
@example(-5.0, 0.7, 0.4, 0.1, 1.0)
def test_the_apex_of_a_thin_wedge_is_found(exponent, turn, back, aside, scale):
    angle = 10.0**exponent
    one = np.array([math.cos(turn), math.sin(turn)])
    other = -np.array([math.cos(turn + angle), math.sin(turn + angle)])
    normals, tip = np.stack([one, other]), np.array([0.2, -0.1]) * scale
    offsets = normals @ tip
    along = np.array([-one[1], one[0]])
    inward = along if other @ along < 0.0 else -along
    nominal = tip + (aside * one - back * inward) * scale  # behind the tip: the tip is the closest control
    truth = apex(normals, offsets)
    assume((normals @ nominal - offsets).max() > 1e-8 * scale)  # less counts as admissible
    answer = project(nominal, normals, offsets, -scale, scale)
    assert answer.status == "projected"
    # The stored rows fix the tip to a rounding over the angle.
    assert np.linalg.norm(answer.control - truth) <= (1e-9 + 1e-14 / angle) * scale


@pytest.mark.parametrize("angle", [1e-6, 1e-7, 1e-8, 1e-10])
def test_of_a_wedge_too_thin_for_the_solver_nothing_wrong_is_said(angle):
    normals = np.array([[1.0, 0.0], [-math.cos(angle), -math.sin(angle)]])
    offsets = normals @ [0.2, -0.1]
    answer = project([0.3, 0.2], normals, offsets, -1.0, 1.0)
    missed = (normals @ answer.control - offsets).max()
    assert answer.status == ("projected" if missed <= 1e-8 else "infeasible")
    assert 0.0 <= answer.violation == max(missed, 0.0) < 1e-6


def test_a_thin_wedge_that_the_box_cuts_off_is_infeasible():
    # The rows meet at u0 = -2, beyond the box; in the box one of them is missed by 0.5e-6 at least.
    answer = project([0.5, 0.3], [[0.0, 1.0], [1e-6, -1.0]], [0.0, -2e-6], -1.0, 1.0)
    assert answer.status == "infeasible"
    assert 0.5e-6 <= answer.violation < 2e-6


def test_a_thin_slab_between_parallel_rows():
    for gap, status in ((1e-6, "projected"), (1e-12, "projected"), (-1e-6, "infeasible")):
        answer = project([0.5, 0.9], [[0.6, 0.8], [-0.6, -0.8]], [0.3 + gap, -0.3], -1.0, 1.0)
        assert answer.status == status
        assert [0.6, 0.8] @ answer.control == pytest.approx(0.3, abs=2e-6)


def test_rows_that_contradict_each_other_by_less_than_an_answer_may_miss_them():
    normals, u = np.array([[0.6, 0.8], [-0.6, -0.8]]), np.array([0.9, 0.9])
    answer = project(u, normals, [-0.3, 0.3 - 1e-9], -1.0, 1.0)
    assert answer.status == "projected" and 0.0 < answer.violation < 2e-9


@given(st.integers(1, 5), st.integers(0, 4), st.integers(0, 2**31), SCALES)
def test_box_least_squares_in_any_unit(n, more, seed, scale):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(n + more, n)), 3.0 * rng.normal(size=n + more)
    a[:n] += np.eye(n)
    low, high = -rng.random(n) - 0.01, rng.random(n) + 0.01
    ours = box_least_squares(a, b * scale, low * scale, high * scale) / scale
    truth = lsq_linear(a, b, (low, high), tol=1e-12).x
    assert np.linalg.norm(a @ ours - b) <= np.linalg.norm(a @ truth - b) + 1e-6
