"""Observability against exact ranks of integer systems, python-control, and systems known by hand."""

from fractions import Fraction

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from safe_wrappers.control.estimation import unobservable_states, unobservable_subspace

SMALL = st.integers(-2, 2).map(float)


@st.composite
def integer_systems(draw):
    """Many of them unobservable: sparse, with small entries, often one state that nothing shows."""
    n, m = draw(st.integers(1, 5)), draw(st.integers(1, 2))
    a = draw(arrays(np.float64, (n, n), elements=SMALL)) * draw(
        arrays(np.float64, (n, n), elements=st.sampled_from([0.0, 1.0]))
    )
    c = draw(arrays(np.float64, (m, n), elements=SMALL))
    if n > 1 and draw(st.booleans()):
        hidden = draw(st.integers(0, n - 1))
        a[np.arange(n) != hidden, hidden] = 0.0
        c[:, hidden] = 0.0
    return a, c


def exact_rank(a, c, *more):
    """Of the observability matrix and more rows, in fractions."""
    block, rows = [[Fraction(int(v)) for v in row] for row in c], [list(row) for row in more]
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


@given(integer_systems())
def test_the_rank_is_the_exact_one_and_the_basis_is_in_the_kernel(system):
    a, c = system
    n, basis = len(a), unobservable_subspace(a, c)
    hidden = n - exact_rank(a, c)
    assert basis.shape == (n, hidden)
    np.testing.assert_allclose(basis.T @ basis, np.eye(hidden), atol=1e-12)
    np.testing.assert_allclose(control.obsv(a, c) @ basis, 0.0, atol=1e-9 * 20.0**n)
    # A state is determined where its unit vector adds nothing to the rank.
    units = [[Fraction(int(i == k)) for i in range(n)] for k in range(n)]
    names = tuple("abcde"[k] for k in range(n) if exact_rank(a, c, units[k]) > n - hidden)
    assert unobservable_states(a, c, "abcde"[:n]) == names
    assert unobservable_states(1e6 * a, 1e-3 * c, "abcde"[:n]) == names


def test_fast_and_slow_modes_side_by_side():
    """Powers of A up to 1e3^7: a rank of the plain matrix loses the slow ones."""
    a, c = np.diag([1e-3, -2e-3, 0.3, -0.7, 11.0, -13.0, 500.0, 1000.0]), np.ones((1, 8))
    assert np.linalg.matrix_rank(control.obsv(a, c)) < 8
    assert unobservable_states(a, c, "abcdefgh") == ()


@pytest.mark.parametrize(
    ("c", "names"),
    [
        ([[1, 0, 0, 0], [0, 1, 0, 0]], ()),
        ([[0, 0, 1, 0], [0, 0, 0, 1]], ("x", "y")),
        ([[0, 0, 0, 0]], ("x", "y", "vx", "vy")),
        ([[0.6, -0.8, 0, 0]], ("x", "y", "vx", "vy")),
        ([[0, 0, 1, 0]], ("x", "y", "vy")),
    ],
)
def test_what_is_not_seen_of_a_point_in_the_plane_is_named(c, names):
    motion = np.kron([[0.0, 1.0], [0.0, 0.0]], np.eye(2))
    assert unobservable_states(motion, c, ("x", "y", "vx", "vy")) == names
