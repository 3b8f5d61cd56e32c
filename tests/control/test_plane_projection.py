"""Projection in the plane against a QP solver, and against a grid where there is no answer."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from qpsolvers import solve_qp

from safe_wrappers.control.backup.drive_decision import project_in_plane

NUMBERS = st.floats(-2.0, 2.0).map(lambda x: round(x, 3))
PAIRS = st.tuples(NUMBERS, NUMBERS)
ROWS = st.lists(st.tuples(NUMBERS, NUMBERS, NUMBERS), max_size=8)
LOW, HIGH = np.array([-1.0, -0.5]), np.array([1.0, 1.5])


def projected(u, rows, slack=1e-9):
    table, out = np.array(rows, dtype=np.float64).reshape(-1, 3), np.full(2, np.nan)
    found = project_in_plane(np.array(u), table[:, :2].copy(), table[:, 2].copy(), LOW, HIGH, slack, out)
    return table[:, :2], table[:, 2], out if found else None


@given(PAIRS, ROWS)
def test_it_is_the_closest_point_that_a_solver_finds(u, rows):
    normals, offsets, answer = projected(u, rows)
    if answer is None:
        # No point of a fine grid keeps every row with room to spare.
        x, y = np.meshgrid(np.linspace(LOW[0], HIGH[0], 41), np.linspace(LOW[1], HIGH[1], 41))
        left = offsets - np.stack([x.ravel(), y.ravel()], axis=1) @ normals.T
        assert not (left > 1e-6).all(axis=1).any()
        return
    assert (answer >= LOW).all() and (answer <= HIGH).all()
    lengths = np.sqrt((normals**2).sum(axis=1))
    assert (normals @ answer - offsets <= 2e-9 * lengths + 1e-12).all()
    used = (normals, offsets) if len(offsets) else (None, None)
    exact = solve_qp(np.eye(2), -np.array(u), *used, lb=LOW, ub=HIGH, solver="clarabel")
    if exact is not None:
        away, best = np.linalg.norm(answer - u), np.linalg.norm(exact - u)
        assert away <= best + 1e-5
        np.testing.assert_allclose(answer, exact, atol=3e-3)


def test_what_keeps_all_rows_is_left_bit_for_bit():
    u = (0.1 + 0.2, -0.3)
    assert projected(u, [(1.0, 0.0, 0.5), (0.0, 0.0, 0.0)])[2].tolist() == list(u)


def test_parallel_rows_and_rows_of_zeros_that_nothing_keeps():
    assert projected((0.0, 0.0), [(1.0, 1.0, -0.2), (1.0, 1.0, -0.2), (-1.0, -1.0, 0.4)])[2].tolist() == [
        -0.1,
        -0.1,
    ]
    assert projected((0.0, 0.0), [(1.0, 0.0, -0.5), (-1.0, 0.0, 0.4)])[2] is None
    assert projected((0.0, 0.0), [(0.0, 0.0, -1.0)])[2] is None
