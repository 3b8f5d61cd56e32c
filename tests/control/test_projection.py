"""project: against clarabel, brute force, KKT residuals and scipy; and every way in which a solver can lie."""

import math

import daqp
import numpy as np
import pytest
import qpsolvers
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import lsq_linear, minimize

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, UnknownNameError
from safe_wrappers.filter import projection, rows_and_box
from safe_wrappers.filter.problem import Status
from safe_wrappers.filter.projection import box_least_squares, project

pytestmark = pytest.mark.filterwarnings("ignore::qpsolvers.warnings.SparseConversionWarning")

SOLVERS = sorted({"daqp", *qpsolvers.available_solvers} - {"qpax"})  # JAX compiles for ten seconds
ONES = np.ones(2)


def clarabel(u, normals, offsets, lower, upper):
    problem = qpsolvers.Problem(
        np.eye(u.size), -u, normals, offsets, lb=np.full(u.size, lower), ub=np.full(u.size, upper)
    )
    solution = qpsolvers.solve_problem(
        problem, solver="clarabel", tol_gap_abs=1e-12, tol_gap_rel=1e-12, tol_feas=1e-12
    )
    return solution.x if solution.found else None


def kkt_residual(u, normals, offsets, lower, upper, answer):
    """Largest violation of the KKT conditions, with the box's multipliers recovered from stationarity."""
    x, lam = answer.control, answer.multipliers
    gradient = x - u + normals.T @ lam
    at_upper, at_lower = x >= upper - 1e-12, x <= lower + 1e-12
    free = ~at_upper & ~at_lower
    wrong_way = np.concatenate([[0.0], gradient[at_upper & ~at_lower], -gradient[at_lower & ~at_upper]])
    return max(
        np.abs(gradient[free]).max(initial=0.0),
        wrong_way.max(),
        np.abs(lam * (normals @ x - offsets)).max(initial=0.0),
        -lam.min(initial=0.0),
        (normals @ x - offsets).max(initial=0.0),
    )


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
        assert kkt_residual(u, normals, offsets, -np.ones(size), np.ones(size), answer) < 1e-7
        assert answer.violation <= 1e-8 * np.linalg.norm(normals, axis=1).max()
        projected += answer.status == "projected"
    assert projected >= 10


def test_two_dimensions_by_brute_force():
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 401)] * 2), -1).reshape(-1, 2)
    rng = np.random.default_rng(0)
    for _ in range(25):
        u, normals, offsets = random_problem(rng, 2, 3)
        answer = project(u, normals, offsets, -ONES, ONES)
        admissible = grid[(grid @ normals.T <= offsets).all(axis=1)]
        best = np.linalg.norm(admissible - u, axis=1).min()
        mine = np.linalg.norm(answer.control - u)
        assert mine <= best + 1e-9
        assert best - mine < 0.02  # the grid's width: nothing outside of the set was returned as closer


def test_clamping_afterwards_is_not_the_answer():
    # The appendix's warning: the free projection is (0.5, 2.5); clamped to the box it violates the row.
    answer = project([2.0, 4.0], [[1.0, 1.0]], [3.0 - 1.5], [-1.0, -1.0], [1.0, 1.0])
    np.testing.assert_allclose(answer.control, [0.5, 1.0], atol=1e-12)
    assert answer.status == "projected"


@pytest.mark.parametrize("solver", SOLVERS)
def test_every_installed_backend_agrees(solver):
    rng = np.random.default_rng(3)
    for _ in range(10):
        u, normals, offsets = random_problem(rng, 4, 6)
        answer = project(u, normals, offsets, -1.0, 1.0, solver=solver)
        reference = clarabel(u, normals, offsets, -1.0, 1.0)
        np.testing.assert_allclose(answer.control, reference, atol=1e-5)
        assert (normals @ answer.control <= offsets + 1e-7).all()
        assert (np.abs(answer.control) <= 1.0).all()


@pytest.mark.parametrize("solver", SOLVERS)
def test_every_installed_backend_gives_the_least_violation(solver):
    normals, offsets = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0]]), np.array([-0.5, -0.25, 0.1])
    answer = project([0.9, 0.9], normals, offsets, -1.0, 1.0, solver=solver)
    assert answer.status == "infeasible"
    np.testing.assert_allclose(answer.control, [-0.125, 0.1], atol=1e-4)
    assert answer.violation == pytest.approx(0.375, abs=1e-4)


# Inactive: bit for bit ----------------------------------------------------------------------------------------


@given(st.lists(st.floats(-1, 1), min_size=1, max_size=5), st.integers(0, 4), st.integers(0, 2**31))
def test_inactive_is_the_nominal_bit_for_bit(nominal, rows, seed):
    u = np.array(nominal)
    normals = np.random.default_rng(seed).normal(size=(rows, u.size))
    before = u.tobytes()
    answer = project(u, normals, normals @ u + 1e-3, -1.0, 1.0)
    assert answer.status == "inactive"
    assert answer.control.tobytes() == before
    assert not answer.multipliers.any() and answer.violation == 0.0 and answer.iterations == 0


@pytest.mark.parametrize("solver", SOLVERS)
def test_inactive_calls_no_solver(monkeypatch, solver):
    def refuse(*_, **__):
        raise AssertionError("a solver was called")

    monkeypatch.setattr(daqp, "solve", refuse)
    monkeypatch.setattr(qpsolvers, "solve_problem", refuse)
    assert (
        project([0.1, 0.2], [[1.0, 0.0], [0.0, 1.0]], [0.5, 0.5], -1, 1, solver=solver).status == "inactive"
    )
    assert project([0.9, 0.2], [[1.0, 0.0]], [0.5], -1, 1, solver=solver).status == "projected"
    with pytest.raises(AssertionError, match="was called"):
        project([0.9, 0.9], [[1.0, 0.1], [0.1, 1.0]], [0.5, 0.5], -1, 1, solver=solver)


def test_no_rows_is_the_box_alone():
    answer = project([0.1, 3.0], np.zeros((0, 2)), [], -1.0, 1.0)
    assert answer.status == "projected"
    np.testing.assert_array_equal(answer.control, [0.1, 1.0])
    assert project([0.1, 0.3], np.zeros((0, 2)), [], -1.0, 1.0).status == "inactive"


# One row and a box, in closed form ----------------------------------------------------------------------------

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
        assert kkt_residual(u, normal, offset, low, high, answer) < 1e-8 * max(1.0, answer.multipliers.max())


@given(one_row())
def test_a_repeated_row_changes_nothing(problem):
    u, normal, offset, low, high = problem
    once = project(u, normal, offset, low, high)
    twice = project(u, np.vstack([normal, normal]), np.concatenate([offset, offset]), low, high)
    assert once.status == twice.status
    np.testing.assert_allclose(once.control, twice.control, atol=2e-6)


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
        for solver in SOLVERS:
            answer = project([0.4, 0.4], normals, offsets, -ONES, ONES, solver=solver)
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


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_satisfied_zero_row_switches_nothing_off(solver):
    # Bug 1: 0 <= 1 made others' filter return the unsafe nominal and report success.
    normals = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]
    answer = project([0.9, 0.9], normals, [1.0, 0.2, 0.3], -ONES, ONES, solver=solver)
    assert answer.status == "projected"
    np.testing.assert_allclose(answer.control, [0.2, 0.3], atol=1e-7)
    assert answer.multipliers[0] == 0.0 and (answer.multipliers[1:] > 0.1).all()


@pytest.mark.parametrize("offset", [0.0, 1e-12, 5.0])
def test_a_zero_row_alone_asks_for_nothing(offset):
    assert project([0.3], [[0.0]], [offset], -1, 1).status == "inactive"


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


def test_rows_that_touch_in_one_point():
    answer = project([1.0, 1.0], [[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0]], [0.25, -0.25, 0.5], -1.0, 1.0)
    assert answer.status == "projected"
    np.testing.assert_allclose(answer.control, [0.25, 0.5], atol=1e-7)


def test_nearly_parallel_rows():
    tilt = 1e-7
    answer = project([1.0, 0.0], [[1.0, tilt], [1.0, -tilt]], [0.5, 0.5], -1.0, 1.0)
    assert answer.status == "projected"
    np.testing.assert_allclose(answer.control, [0.5, 0.0], atol=1e-6)


@pytest.mark.parametrize("scale", [1e-140, 1e-9, 1e9, 1e140])
def test_a_rows_scale_does_not_matter(scale):
    answer = project([0.9, 0.1], [[scale, 0.0], [0.0, scale]], [0.5 * scale, 0.5 * scale], -1.0, 1.0)
    assert answer.status == "projected"
    np.testing.assert_allclose(answer.control, [0.5, 0.1], atol=1e-7)


@pytest.mark.parametrize("rows", [1, 2])
def test_a_row_too_large_to_square_is_never_inactive(rows):
    # The length overflows: an infinite tolerance would let everything through.
    answer = project([0.9, 0.9], np.eye(2)[:rows] * 1e200, np.full(rows, -1e199), -1.0, 1.0)
    assert answer.status != "inactive"
    assert (answer.control[:rows] < 0.0).all() or answer.status in ("failed", "infeasible")


@pytest.mark.filterwarnings("ignore:overflow")
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_offsets_whose_sum_overflows(sign):
    answer = project([0.3, 0.3], np.eye(2), [sign * 1e308] * 2, -ONES, ONES)
    assert answer.status == ("inactive" if sign > 0.0 else "failed")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", ["normal", "offset"])
@pytest.mark.parametrize("others", [0, 1, 2])
def test_a_row_that_is_not_finite_fails_and_the_others_hold(bad, where, others):
    normals = np.vstack([[1.0, 0.5], np.eye(2)[:others]])
    offsets = np.array([2.0, 0.2, 0.3])[: 1 + others]
    if where == "normal":
        normals[0, 0] = bad
    else:
        offsets[0] = bad
    answer = project([0.9, 0.9], normals, offsets, -ONES, ONES)
    if where == "offset" and bad == np.inf:  # asks for nothing
        assert answer.status == ("projected" if others else "inactive")
    else:
        assert answer.status == "failed"
        assert answer.violation == math.inf
    expected = [0.2, 0.3][:others] + [0.9] * (2 - others)
    np.testing.assert_allclose(answer.control, expected, atol=1e-6)
    assert answer.multipliers.shape == (1 + others,)


# Solvers that lie ---------------------------------------------------------------------------------------------

NORMALS, OFFSETS, NOMINAL = np.array([[1.0, 0.3], [0.2, 1.0]]), np.array([-0.4, -0.5]), np.array([0.9, 0.8])
LIES = {
    "nan called found": (True, [np.nan, np.nan]),
    "infinite called found": (True, [np.inf, 0.0]),
    "zero called not found": (False, [0.0, 0.0]),
    "infeasible point called found": (True, [0.0, 0.0]),
    "the nominal called found": (True, [0.9, 0.8]),
    "outside of the box called found": (True, [-30.0, 2.45]),
    "nothing": (False, None),
}


def lying(found, x):
    def solve_problem(problem, **_):
        solution = qpsolvers.Solution(problem)
        solution.found = found
        size = problem.q.size
        solution.x = None if x is None else np.resize(np.array(x), size)
        solution.z = np.zeros(problem.h.size)
        return solution

    return solve_problem


@pytest.mark.parametrize("lie", LIES)
def test_a_lying_backend_is_not_believed(monkeypatch, lie):
    # Bugs 2 and 3. The least-violation problem falls back on daqp, so the answer is still the right one.
    truth = project(NOMINAL, NORMALS, OFFSETS, -1.0, 1.0)
    with monkeypatch.context() as patch:
        patch.setattr(qpsolvers, "solve_problem", lying(*LIES[lie]))
        answer = project(NOMINAL, NORMALS, OFFSETS, -1.0, 1.0, solver="clarabel")
    assert np.isfinite(answer.control).all()
    assert (np.abs(answer.control) <= 1.0).all()
    if answer.status in ("projected", "inactive"):
        assert (NORMALS @ answer.control <= OFFSETS + 1e-7).all()
        np.testing.assert_allclose(answer.control, truth.control, atol=1e-4)
    assert answer.status != "inactive"
    # and the next call knows nothing of it
    after = project(NOMINAL, NORMALS, OFFSETS, -1.0, 1.0, solver="clarabel")
    assert after.status == "projected"
    np.testing.assert_allclose(after.control, truth.control, atol=1e-7)


def test_a_feasible_answer_that_is_not_the_closest_is_not_called_the_projection(monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(qpsolvers, "solve_problem", lying(True, [-1.0, -1.0]))
        answer = project(NOMINAL, NORMALS, OFFSETS, -1.0, 1.0, solver="clarabel")
    truth = project(NOMINAL, NORMALS, OFFSETS, -1.0, 1.0)
    if answer.status == "projected":
        np.testing.assert_allclose(answer.control, truth.control, atol=1e-4)


@pytest.mark.parametrize(
    "error", [qpsolvers.exceptions.SolverError("x"), ValueError("x"), ZeroDivisionError()]
)
def test_a_backend_that_raises_is_replaced(monkeypatch, error):
    def solve_problem(*_, **__):
        raise error

    monkeypatch.setattr(qpsolvers, "solve_problem", solve_problem)
    answer = project(NOMINAL, NORMALS, OFFSETS, -1.0, 1.0, solver="clarabel")
    assert answer.status == "projected"
    np.testing.assert_allclose(answer.control, project(NOMINAL, NORMALS, OFFSETS, -1, 1).control, atol=1e-5)


@pytest.mark.parametrize("flag", [-1, 0, 1])
@pytest.mark.parametrize("x", [[np.nan, np.nan], [0.0, 0.0]])
def test_when_every_solver_lies_the_status_says_failed(monkeypatch, flag, x):
    def solve(h, f, a, bupper, blower, sense, primal_tol):
        return np.resize(np.array(x), f.size), 0.0, flag, {"lam": np.zeros(bupper.size), "iterations": 1}

    def give_up(u, a, b, lo, hi, named, control, multipliers):
        control[:], multipliers[:] = np.clip(u, lo, hi), 0.0
        return rows_and_box.UNSOLVED, float((a @ control - b).max()), 99

    with monkeypatch.context() as patch:
        patch.setattr(daqp, "solve", solve)
        # A named solver that has no answer is replaced.
        assert project(NOMINAL, NORMALS, OFFSETS, -1.0, 1.0, solver="daqp").status == "projected"
        patch.setattr(projection, "keep_rows", give_up)
        for solver in ("active-set", "daqp"):
            answer = project(NOMINAL, NORMALS, OFFSETS, -1.0, 1.0, solver=solver)
            assert answer.status == "failed" and not answer.multipliers.any()
            np.testing.assert_array_equal(answer.control, NOMINAL)
            assert answer.violation == pytest.approx((NORMALS @ NOMINAL - OFFSETS).max())
    assert project(NOMINAL, NORMALS, OFFSETS, -1.0, 1.0).status == "projected"


def test_what_the_active_set_gives_up_is_left_to_daqp(monkeypatch):
    truth = project(NOMINAL, NORMALS, OFFSETS, -1.0, 1.0)
    monkeypatch.setattr(projection, "keep_rows", lambda *_: (rows_and_box.UNSOLVED, 0.0, 99))
    answer = project(NOMINAL, NORMALS, OFFSETS, -1.0, 1.0)
    assert answer.status == "projected"
    np.testing.assert_allclose(answer.control, truth.control, atol=1e-9)
    np.testing.assert_allclose(answer.multipliers, truth.multipliers, atol=1e-9)


def test_an_infeasible_solve_does_not_poison_the_next():
    expected = project(NOMINAL, NORMALS, OFFSETS, -1.0, 1.0)
    for solver in SOLVERS:
        for _ in range(3):
            assert project(NOMINAL, NORMALS, [-9.0, -9.0], -1.0, 1.0, solver=solver).status == "infeasible"
            after = project(NOMINAL, NORMALS, OFFSETS, -1.0, 1.0, solver=solver)
            assert after.status == "projected"
            np.testing.assert_allclose(after.control, expected.control, atol=1e-6)


def test_arguments_are_not_written_to():
    arrays = [NOMINAL.copy(), NORMALS.copy(), OFFSETS.copy(), -ONES, ONES.copy()]
    copies = [a.copy() for a in arrays]
    project(*arrays)
    for array, copy in zip(arrays, copies, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_the_answer_does_not_share_memory_with_the_argument():
    u = np.array([0.1, 0.2])
    answer = project(u, [[1.0, 0.0]], [0.5], -1.0, 1.0)
    u[:] = 9.0
    np.testing.assert_array_equal(answer.control, [0.1, 0.2])


# Refusals -----------------------------------------------------------------------------------------------------


def test_an_unknown_solver_lists_the_installed():
    with pytest.raises(UnknownNameError, match="'gurobbi' is not installed") as caught:
        project([0.0], [[1.0]], [1.0], -1, 1, solver="gurobbi")
    assert all(name in str(caught.value) for name in qpsolvers.available_solvers)


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


def test_public_name_and_status_are_strings():
    answer = sw.project([0.0], [[1.0]], [1.0], [-1.0], [1.0])
    assert isinstance(answer, sw.filter.projection.Projection)
    assert answer.status == "inactive" and isinstance(answer.status, Status)


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
