"""A projection that no solver has answered is called failed, and not infeasible: nothing has shown that it is."""

import daqp
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.filter import projection, rows_and_box

ROWS = np.array([[1.0, 0.2], [-0.3, 1.0]])


def give_up(u, normals, offsets, low, high, named, control, multipliers):
    control[:], multipliers[:] = np.clip(u, low, high), 0.0
    return rows_and_box.UNSOLVED, 0.0, 99


def none_found(h, f, a, upper, lower, sense, primal_tol):
    return np.zeros(f.size), 0.0, -1, {"lam": np.zeros(upper.size), "iterations": 1}


@pytest.mark.parametrize(
    ("rows", "offsets", "truth"),
    [
        (ROWS, [0.3, 0.2], "projected"),
        (np.array([[1.0, 1.0], [-1.0, -1.0]]), [-0.5, -0.5], "infeasible"),
        (ROWS, [-5.0, 0.2], "infeasible"),  # beyond the box
    ],
    ids=["feasible", "contradictory", "outside the box"],
)
def test_when_every_solver_gives_up_the_status_says_failed(monkeypatch, rows, offsets, truth):
    nominal = [0.9, 0.8]
    assert sw.project(nominal, rows, offsets, -1.0, 1.0).status == truth
    with monkeypatch.context() as patch:
        patch.setattr(daqp, "solve", none_found)
        patch.setattr(projection, "keep_rows", give_up)
        answer = sw.project(nominal, rows, offsets, -1.0, 1.0)
    assert answer.status == "failed"
    assert (np.abs(answer.control) <= 1.0).all()
    assert answer.violation == pytest.approx((rows @ answer.control - offsets).max())


def test_a_control_beyond_the_action_s_dtype_is_cast_to_its_largest_number():
    far = np.array([1e300, -1e39, 0.5])
    no_rows = np.zeros((0, 3)), np.zeros(0)
    sent = projection.cast_inside(far, np.float32, *no_rows, np.full(3, -np.inf), np.full(3, np.inf))
    most = np.finfo(np.float32).max
    assert sent.dtype == np.float32 and sent.tolist() == [most, -most, 0.5]


def test_a_least_squares_answer_that_is_no_optimum_is_not_taken(monkeypatch):
    a, b = np.array([[1.0, 0.2], [0.0, 1.0], [0.3, 0.1]]), np.array([0.4, -0.2, 0.1])
    problem = a, b, np.full(2, -1.0), np.full(2, 1.0)
    right, real = projection.box_least_squares(*problem), daqp.solve

    def elsewhere(*arguments, **options):
        x, value, _, info = real(*arguments, **options)
        return x + 0.5, value, 1, info

    monkeypatch.setattr(daqp, "solve", elsewhere)
    np.testing.assert_allclose(projection.box_least_squares(*problem), right, atol=1e-9)  # inside the box
