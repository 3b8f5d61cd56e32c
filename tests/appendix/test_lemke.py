"""Lemke's method: against enumeration of all complementary bases, NNLS and a linear program."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog, nnls

from safe_wrappers.appendix.contact.lemke import LcpStatus, solve_lcp
from safe_wrappers.errors import ConfigurationError


def enumerated(m, q, tolerance=1e-9):
    """Every solution at a nonsingular complementary basis."""
    n, found = len(q), []
    for active in itertools.product([False, True], repeat=n):
        a = np.flatnonzero(active)
        z = np.zeros(n)
        if len(a):
            if abs(np.linalg.det(m[np.ix_(a, a)])) < 1e-9:
                continue
            z[a] = np.linalg.solve(m[np.ix_(a, a)], -q[a])
        if (z >= -tolerance).all() and (m @ z + q >= -tolerance).all():
            found.append(z)
    return found


def assert_conditions(m, q, found):
    size = np.abs(m).max() * np.abs(found.z).max() + np.abs(q).max()
    assert (found.z >= 0.0).all() and (found.w >= -1e-8 * size).all()
    np.testing.assert_allclose(found.w, m @ found.z + q)
    assert abs(found.z @ found.w) <= 1e-7 * size * max(1.0, found.z.max())


def problem(seed, n, rank, whole):
    """A positive semidefinite problem of some rank; of whole numbers it is full of ties."""
    rng = np.random.default_rng(seed)
    draw = (
        (lambda *shape: rng.integers(-2, 3, shape).astype(float))
        if whole
        else (lambda *s: rng.normal(size=s))
    )
    root = draw(n, rank)
    return root @ root.T, draw(n)


problems = st.tuples(st.integers(0, 2**32), st.integers(1, 5), st.integers(1, 5), st.booleans())


@given(problems)
def test_semidefinite_problems_are_solved_exactly_where_they_can_be(drawn):
    m, q = problem(*drawn)
    found = solve_lcp(m, q)
    # Feasible is solvable for them: some z >= 0 with M z + q >= 0.
    feasible = linprog(np.zeros(len(q)), A_ub=-m, b_ub=q, bounds=(0, None), method="highs").status == 0
    assert found.status is (LcpStatus.SOLVED if feasible else LcpStatus.RAY)
    if feasible:
        assert_conditions(m, q, found)
        # All solutions have the same M z.
        for z in enumerated(m, q):
            np.testing.assert_allclose(m @ found.z, m @ z, atol=1e-6)
    else:
        assert not enumerated(m, q) and not found.z.any()


@given(st.integers(0, 2**32), st.integers(1, 12))
def test_definite_problems_have_the_minimum_that_nnls_finds(seed, n):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n))
    m, q = root @ root.T + 0.05 * np.eye(n), rng.normal(size=n)
    lower = np.linalg.cholesky(m)
    least, _ = nnls(lower.T, -np.linalg.solve(lower, q))  # |L' z + L^-1 q|^2 = z.M z + 2 q.z + const
    found = solve_lcp(m, q)
    assert found.status is LcpStatus.SOLVED
    np.testing.assert_allclose(found.z, least, atol=1e-7 * max(1.0, least.max()))


@given(st.integers(0, 2**32), st.integers(2, 4))
def test_a_p_matrix_gives_the_only_solution(seed, n):
    # Not symmetric: diagonally dominant, so every principal minor is positive.
    rng = np.random.default_rng(seed)
    m = rng.uniform(-1.0, 1.0, (n, n))
    np.fill_diagonal(m, np.abs(m).sum(axis=1) + 0.1)
    q = rng.normal(size=n)
    (only,) = enumerated(m, q)
    np.testing.assert_allclose(solve_lcp(m, q).z, only, atol=1e-9)


def test_any_answer_of_any_matrix_satisfies_the_conditions():
    rng = np.random.default_rng(5)
    ends = {status: 0 for status in LcpStatus}
    for _ in range(500):
        n = int(rng.integers(1, 6))
        m, q = rng.normal(size=(n, n)), rng.normal(size=n)
        found = solve_lcp(m, q)
        ends[found.status] += 1
        if found.status is LcpStatus.SOLVED:
            assert_conditions(m, q, found)
    assert ends[LcpStatus.SOLVED] > 200 and ends[LcpStatus.RAY] > 50 and ends[LcpStatus.FAILED] == 0


def test_murtys_problem_needs_pivots_and_ends():
    # Murty (1978): ones on the diagonal, twos below; some starts of pivoting methods visit every basis.
    for n in range(2, 9):
        m = np.eye(n) + 2.0 * np.tril(np.ones((n, n)), -1)
        found = solve_lcp(m, -np.ones(n))
        assert found.status is LcpStatus.SOLVED and found.pivots <= 2**n
        np.testing.assert_allclose(found.z, np.eye(n)[0], atol=1e-12)


def test_nothing_to_do_takes_no_pivot():
    found = solve_lcp(-np.eye(2), [0.0, 3.0])
    assert found.pivots == 0 and found.z.tolist() == [0.0, 0.0] and found.w.tolist() == [0.0, 3.0]


def test_no_solution_is_a_ray_and_no_numbers():
    found = solve_lcp([[0.0]], [-1.0])
    assert found.status is LcpStatus.RAY and found.z.tolist() == [0.0] and found.w.tolist() == [-1.0]


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_units_do_not_matter(scale):
    m, q = problem(3, 5, 5, False)
    np.testing.assert_allclose(solve_lcp(m * scale, q / scale).z * scale**2, solve_lcp(m, q).z, rtol=1e-9)


@pytest.mark.parametrize(
    ("m", "q", "said"),
    [
        (np.eye(2), np.ones(3), "shape"),
        (np.eye(2), np.ones((2, 1)), "shape"),
        (np.zeros((0, 0)), np.zeros(0), "shape"),
        (np.full((1, 1), np.nan), np.ones(1), "matrix must be finite"),
        (np.eye(1), [np.inf], "vector must be finite"),
    ],
)
def test_bad_input_is_refused_in_words(m, q, said):
    with pytest.raises(ConfigurationError, match=said):
        solve_lcp(m, q)
