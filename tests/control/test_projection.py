"""project: against clarabel, brute force, KKT residuals and scipy; and every way in which a solver can lie."""

import math

import clarabel as clarabel_solver
import daqp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import lsq_linear, minimize, nnls
from scipy.sparse import csc_matrix

from safe_wrappers.control.projection import box_least_squares, project
from safe_wrappers.errors import ConfigurationError

ONES = np.ones(2)


def clarabel(u, normals, offsets, lower, upper):
    unit = np.eye(u.size)
    rows = np.vstack([normals, unit, -unit])
    limits = np.concatenate([offsets, np.full(u.size, upper), -np.full(u.size, lower)])
    settings = clarabel_solver.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-12
    cones = [clarabel_solver.NonnegativeConeT(len(limits))]
    return (
        clarabel_solver.DefaultSolver(csc_matrix(unit), -u, csc_matrix(rows), limits, cones, settings)
        .solve()
        .x
    )


def kkt_residual(u, normals, offsets, lower, upper, x):
    """By how much an answer breaks a row, or the way to it is no sum of outward normals that hold."""
    unit, reach = np.eye(u.size), 1e-9 * (1.0 + np.abs(x).max())
    lengths = np.maximum(np.linalg.norm(normals, axis=1), 1e-300)
    holds = (normals @ x - offsets) / lengths > -reach
    outward = np.vstack(
        [(normals / lengths[:, None])[holds], unit[x >= upper - reach], -unit[x <= lower + reach]]
    )
    left = nnls(outward.T, u - x)[1] if len(outward) else np.linalg.norm(u - x)
    return max(left, ((normals @ x - offsets) / lengths).max(initial=0.0))


def random_problem(rng, size, rows):
    """A problem with a feasible point inside the box and a nominal that may lie outside of everything."""
    normals = rng.normal(size=(rows, size))
    inside = rng.uniform(-0.9, 0.9, size)
    return 3.0 * rng.normal(size=size), normals, normals @ inside + rng.exponential(0.2, rows)


# The nearest admissible control -------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1, 2, 3, 7, 17])
@pytest.mark.parametrize("rows", [1, 2, 5, 20])
def test_agrees_with_clarabel_and_meets_kkt(size, rows):
    rng = np.random.default_rng([size, rows])
    projected = 0
    for _ in range(20):
        u, normals, offsets = random_problem(rng, size, rows)
        answer = project(u, normals, offsets, -1.0, 1.0)
        expected = clarabel(u, normals, offsets, -1.0, 1.0)
        np.testing.assert_allclose(answer.control, expected, atol=2e-7)
        assert answer.status in ("projected", "inactive")
        assert kkt_residual(u, normals, offsets, -np.ones(size), np.ones(size), answer.control) < 1e-7
        assert answer.violation <= 1e-8 * np.linalg.norm(normals, axis=1).max()
        projected += answer.status == "projected"
    assert projected >= 10


# Inactive: bit for bit ----------------------------------------------------------------------------------------


@given(st.lists(st.floats(-1, 1), min_size=1, max_size=5), st.integers(0, 4), st.integers(0, 2**31))
def test_inactive_is_the_nominal_bit_for_bit(nominal, rows, seed):
    u = np.array(nominal)
    normals = np.random.default_rng(seed).normal(size=(rows, u.size))
    before = u.tobytes()
    answer = project(u, normals, normals @ u + 1e-3, -1.0, 1.0)
    assert answer.status == "inactive"
    assert answer.control.tobytes() == before
    assert answer.violation == 0.0


def test_what_is_inactive_calls_no_solver(monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("a solver was called")

    monkeypatch.setattr(daqp, "solve", refuse)
    assert project([0.1, 0.2], [[1.0, 0.0], [0.0, 1.0]], [0.5, 0.5], -1, 1).status == "inactive"
    with pytest.raises(AssertionError, match="was called"):
        project([0.9, 0.2], [[1.0, 0.0]], [0.5], -1, 1)


# One row and a box, against a closed form ---------------------------------------------------------------------

FINITE = st.floats(-5, 5).map(lambda v: round(v, 3))
ENTRY = st.one_of(st.just(0.0), FINITE)


@st.composite
def one_row(draw):
    size = draw(st.integers(1, 5))
    low, high = [], []
    for _ in range(size):
        a, b = sorted((draw(FINITE), draw(FINITE)))
        low.append(draw(st.sampled_from([a, a, -math.inf])))
        high.append(draw(st.sampled_from([b, b, math.inf])))
    nominal = [draw(FINITE) for _ in range(size)]  # may lie outside of the box
    normal = [draw(ENTRY) for _ in range(size)]
    return np.array(nominal), np.array([normal]), np.array([draw(FINITE)]), np.array(low), np.array(high)


@given(one_row())
def test_one_row_and_box_is_exact(problem):
    u, normal, offset, low, high = problem
    answer = project(u, normal, offset, low, high)
    x = answer.control
    assert ((low <= x) & (x <= high)).all()
    corner = np.where(normal[0] > 0, low, np.where(normal[0] < 0, high, 0.0))
    least = sum(a * c for a, c in zip(normal[0], corner, strict=True) if a)
    if least > offset[0] + 1e-6:
        assert answer.status == "infeasible"
        assert normal[0] @ x == pytest.approx(least, abs=1e-9)
        idle = normal[0] == 0.0
        np.testing.assert_array_equal(x[idle], np.clip(u, low, high)[idle])
    elif least < offset[0] - 1e-6:
        assert answer.status in ("projected", "inactive")
        assert kkt_residual(u, normal, offset, low, high, x) < 1e-8


# Infeasible: the least violation ------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(8))
def test_least_violation_agrees_with_scipy(seed):
    rng = np.random.default_rng(seed)
    size = int(rng.integers(1, 5))
    normals = rng.normal(size=(size + 3, size))
    normals[1] = -normals[0] * rng.uniform(0.3, 3.0)  # contradict each other
    offsets = rng.normal(size=size + 3) * 0.2
    offsets[:2] = -rng.uniform(0.1, 0.4, 2)
    u = rng.normal(size=size)
    answer = project(u, normals, offsets, -1.0, 1.0)
    assert answer.status == "infeasible"
    lengths = np.linalg.norm(normals, axis=1)

    def squared(x):
        return float((np.maximum(0.0, (normals @ x - offsets) / lengths) ** 2).sum())

    starts = [np.zeros(size), u.clip(-1, 1), *rng.uniform(-1, 1, (4, size))]
    options = {"ftol": 1e-14, "gtol": 1e-10}
    found = min(
        (minimize(squared, s, bounds=[(-1, 1)] * size, method="L-BFGS-B", options=options) for s in starts),
        key=lambda r: r.fun,
    )
    assert squared(answer.control) <= found.fun + 1e-6
    assert answer.violation == pytest.approx((normals @ answer.control - offsets).max())
    assert (np.abs(answer.control) <= 1.0).all()


def test_among_the_least_violating_the_closest_to_the_nominal():
    # u0 is fought over, u1 is free: it stays what the policy asked for.
    answer = project([0.0, 0.3], [[1.0, 0.0], [-1.0, 0.0]], [-0.5, -0.5], -1.0, 1.0)
    assert answer.status == "infeasible"
    np.testing.assert_allclose(answer.control, [0.0, 0.3], atol=1e-4)


def test_the_box_is_never_softened():
    # Bug 4: barriers far beyond the box; the answer is the box's corner, and says infeasible.
    for normals, offsets in (
        ([[1.0, 0.0]], [-5.0]),
        ([[1.0, 0.0], [0.0, 1.0]], [-5.0, -7.0]),
        ([[1.0, 0.2], [0.1, 1.0], [1.0, 1.0]], [-50.0, -70.0, -9.0]),
    ):
        answer = project([0.4, 0.4], normals, offsets, -ONES, ONES)
        assert answer.status == "infeasible"
        assert (np.abs(answer.control) <= 1.0).all()
        assert answer.control[0] == pytest.approx(-1.0, abs=1e-6)


@given(st.integers(0, 2**31), st.integers(1, 4), st.integers(1, 6), st.floats(-3, 1))
def test_the_answer_is_always_finite_inside_the_box_and_honest(seed, size, rows, shift):
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(rows, size)) * 10.0 ** rng.uniform(-3, 3, (rows, 1))
    normals[rng.random((rows, size)) < 0.2] = 0.0
    offsets = (rng.normal(size=rows) + shift) * np.maximum(np.linalg.norm(normals, axis=1), 1e-3)
    low = -rng.uniform(0, 2, size)
    high = low + rng.choice([0.0, 1.0, 3.0], size)
    answer = project(2 * rng.normal(size=size), normals, offsets, low, high)
    assert np.isfinite(answer.control).all()
    assert ((low <= answer.control) & (answer.control <= high)).all()
    excess = normals @ answer.control - offsets
    assert answer.violation == pytest.approx(max(0.0, excess.max()), abs=1e-9 * (1 + np.abs(offsets).max()))
    if answer.status in ("projected", "inactive"):
        assert (excess <= 2e-8 * np.linalg.norm(normals, axis=1)).all()
    else:
        assert answer.status == "infeasible"
        assert clarabel_says_infeasible(normals, offsets, low, high)


def clarabel_says_infeasible(normals, offsets, low, high):
    """No control in the box keeps the rows by more than round-off, by linear programming."""
    from scipy.optimize import linprog

    lengths = np.maximum(np.linalg.norm(normals, axis=1), 1e-300)
    a = np.hstack([normals, -lengths[:, None]])
    cost = np.append(np.zeros(normals.shape[1]), 1.0)
    bounds = [*zip(low, high, strict=True), (None, None)]
    solved = linprog(cost, A_ub=a, b_ub=offsets, bounds=bounds)
    zero_row = bool((offsets[np.linalg.norm(normals, axis=1) == 0.0] < 0.0).any())
    return zero_row or solved.status != 0 or solved.x[-1] > -1e-7


# Degenerate rows, one by one ----------------------------------------------------------------------------------


def test_a_satisfied_zero_row_switches_nothing_off():
    # Bug 1: 0 <= 1 made others' filter return the unsafe nominal and report success.
    normals = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]
    answer = project([0.9, 0.9], normals, [1.0, 0.2, 0.3], -ONES, ONES)
    assert answer.status == "projected"
    np.testing.assert_allclose(answer.control, [0.2, 0.3], atol=1e-7)


@pytest.mark.parametrize("others", [0, 1, 2])
def test_a_violated_zero_row_is_infeasible_and_the_others_still_hold(others):
    normals = np.vstack([[0.0, 0.0], np.eye(2)[:others]])
    answer = project([0.9, 0.9], normals, [-1.0, 0.2, 0.3][: 1 + others], -ONES, ONES)
    assert answer.status == "infeasible"
    assert answer.violation == pytest.approx(1.0)
    expected = [0.2, 0.3][:others] + [0.9] * (2 - others)
    np.testing.assert_allclose(answer.control, expected, atol=1e-6)


def test_contradictory_rows_are_infeasible_whatever_their_scale():
    for scale in (1e-4, 1.0, 1e4):
        answer = project([0.0], [[scale], [-scale]], [-0.1 * scale, -0.3 * scale], -1.0, 1.0)
        assert answer.status == "infeasible"
        np.testing.assert_allclose(answer.control, [0.1], atol=1e-5)


def test_a_box_of_zero_width_is_its_point():
    answer = project([0.5, 0.5], [[1.0, 1.0], [1.0, -1.0]], [0.4, 0.9], [-1.0, 0.2], [1.0, 0.2])
    assert answer.status == "projected"
    np.testing.assert_allclose(answer.control, [0.2, 0.2], atol=1e-8)


@pytest.mark.parametrize("scale", [1e-200, 1e-140, 1e-9, 1e9, 1e140, 1e200])
def test_a_rows_scale_does_not_matter(scale):
    answer = project([0.9, 0.1], [[scale, 0.0], [0.0, scale]], [0.5 * scale, 0.5 * scale], -1.0, 1.0)
    assert answer.status == "projected"
    np.testing.assert_allclose(answer.control, [0.5, 0.1], atol=1e-7)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("bound", [1.0, math.inf])
@pytest.mark.parametrize("rows", [1, 2])
def test_an_answer_that_overflows_is_none(rows, bound):
    answer = project([0.3, 0.3], np.eye(2)[:rows] * 1e-140, np.full(rows, -1e299), -bound, bound)
    assert answer.status in ("infeasible", "failed")
    assert np.isfinite(answer.control).all() and (np.abs(answer.control) <= bound).all()


@pytest.mark.filterwarnings("ignore:overflow")
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_offsets_whose_sum_overflows(sign):
    answer = project([0.3, 0.3], np.eye(2), [sign * 1e308] * 2, -ONES, ONES)
    assert answer.status == ("inactive" if sign > 0.0 else "failed")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", ["normal", "offset"])
@pytest.mark.parametrize("others", [0, 1, 2])
def test_a_row_that_is_not_finite_fails(bad, where, others):
    normals = np.vstack([[1.0, 0.5], np.eye(2)[:others]])
    offsets = np.array([2.0, 0.2, 0.3])[: 1 + others]
    if where == "normal":
        normals[0, 0] = bad
    else:
        offsets[0] = bad
    answer = project([0.9, 0.9], normals, offsets, -ONES, ONES)
    expected = [0.9, 0.9]
    if where == "offset" and bad == np.inf:  # asks for nothing
        assert answer.status == ("projected" if others else "inactive")
        expected = [0.2, 0.3][:others] + [0.9] * (2 - others)
    else:
        assert answer.status == "failed"
        assert answer.violation == math.inf
    np.testing.assert_allclose(answer.control, expected, atol=1e-6)


# Solvers that lie ---------------------------------------------------------------------------------------------

NORMALS, OFFSETS, NOMINAL = np.array([[1.0, 0.3], [0.2, 1.0]]), np.array([-0.4, -0.5]), np.array([0.9, 0.8])
LIES = {
    "nan called found": ([np.nan, np.nan], 1),
    "infinite called found": ([np.inf, 0.0], 1),
    "zero called infeasible": ([0.0, 0.0], -1),
    "infeasible point called found": ([0.0, 0.0], 1),
    "the nominal called found": ([0.9, 0.8], 1),
    "outside of the box called found": ([-30.0, 2.45], 1),
    "feasible point that is not the closest called found": ([-1.0, -1.0], 1),
    "limit of iterations": ([0.0, 0.0], -4),
}


def lying(x, flag):
    return lambda h, f, a, upper, *_, **__: (np.resize(np.array(x), f.size), 0.0, flag, {})


@pytest.mark.parametrize("lie", LIES)
def test_daqp_is_not_believed(monkeypatch, lie):
    truth = project(NOMINAL, NORMALS, OFFSETS, -1.0, 1.0)
    assert truth.status == "projected"
    with monkeypatch.context() as patch:
        patch.setattr(daqp, "solve", lying(*LIES[lie]))
        answer = project(NOMINAL, NORMALS, OFFSETS, -1.0, 1.0)
    missed = (NORMALS @ answer.control - OFFSETS).max()
    assert (np.abs(answer.control) <= 1.0).all()
    assert answer.violation == pytest.approx(max(0.0, missed))
    assert (answer.status == "projected") == (missed <= 0.0)
    assert lie.startswith("feasible") == (missed <= 0.0)
    after = project(NOMINAL, NORMALS, OFFSETS, -1.0, 1.0)  # and the next call knows nothing of it
    assert after.control.tobytes() == truth.control.tobytes()


@pytest.mark.parametrize("lie", [lie for lie in LIES if not lie.startswith("feasible")])
def test_where_the_first_answer_is_wrong_the_softened_rows_have_the_right_one(monkeypatch, lie):
    truth, asked, real = project(NOMINAL, NORMALS, OFFSETS, -1.0, 1.0), [], daqp.solve

    def first_wrong(*arguments, **options):
        asked.append(arguments)
        return (real if len(asked) > 1 else lying(*LIES[lie]))(*arguments, **options)

    monkeypatch.setattr(daqp, "solve", first_wrong)
    answer = project(NOMINAL, NORMALS, OFFSETS, -1.0, 1.0)
    assert len(asked) == 2 and answer.status == "projected"
    np.testing.assert_allclose(answer.control, truth.control, atol=1e-8)


def test_an_infeasible_solve_does_not_poison_the_next():
    expected = project(NOMINAL, NORMALS, OFFSETS, -1.0, 1.0)
    for _ in range(3):
        assert project(NOMINAL, NORMALS, [-9.0, -9.0], -1.0, 1.0).status == "infeasible"
        after = project(NOMINAL, NORMALS, OFFSETS, -1.0, 1.0)
        assert after.status == "projected" and after.control.tobytes() == expected.control.tobytes()


def test_arguments_are_not_written_to():
    arrays = [NOMINAL.copy(), NORMALS.copy(), OFFSETS.copy(), -ONES, ONES.copy()]
    copies = [a.copy() for a in arrays]
    project(*arrays)
    for array, copy in zip(arrays, copies, strict=True):
        np.testing.assert_array_equal(array, copy)


# Refusals -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([np.nan], [[1.0]], [1.0], -1, 1), "u_nom must be finite"),
        (([np.inf], [[1.0]], [1.0], -1, 1), "u_nom must be finite"),
        (([0.0], [[1.0]], [1.0], 1.0, -1.0), "lower must not exceed upper"),
        (([0.0], [[1.0]], [1.0], np.nan, 1.0), "lower must not exceed upper"),
        (([0.0, 0.0], [[1.0]], [1.0], -1, 1), r"expected u_nom \(m,\)"),
        (([0.0, 0.0], [[1.0, 1.0]], [1.0, 2.0], -1, 1), r"expected u_nom \(m,\)"),
        (([0.0, 0.0, 0.0], np.ones((3, 2)), [1.0, 2.0], -1, 1), r"expected u_nom \(m,\)"),  # transposed
        (([0.0, 0.0], [[1.0, 1.0]], [1.0], [-1.0] * 3, 1), r"expected bounds of shape \(2,\)"),
    ],
)
def test_nonsense_is_refused(arguments, message):
    with pytest.raises(ConfigurationError, match=message):
        project(*arguments)


def test_box_least_squares_of_no_numbers_is_none():
    assert box_least_squares(np.zeros((3, 0)), np.ones(3), np.zeros(0), np.zeros(0)).shape == (0,)


@given(st.integers(1, 6), st.integers(0, 6), st.integers(0, 2**31))
def test_box_least_squares_agrees_with_scipy(n, more, seed):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(n + more, n)), 3.0 * rng.normal(size=n + more)
    a += np.vstack([np.eye(n), np.zeros((more, n))])
    low, high = -rng.random(n) - 0.01, rng.random(n) + 0.01
    ours = box_least_squares(a, b, low, high)
    truth = lsq_linear(a, b, (low, high), tol=1e-12).x
    assert np.linalg.norm(a @ ours - b) <= np.linalg.norm(a @ truth - b) + 1e-6
    assert ((ours >= low) & (ours <= high)).all()
