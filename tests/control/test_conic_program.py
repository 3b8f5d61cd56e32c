"""Programs against closed forms, against daqp, and programs that have no answer."""

import daqp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.control.whole_body import Program, by_clarabel


def nearest(point, **parts):
    """The program of the closest point."""
    n = len(point)
    fields = {
        "equal": np.zeros((0, n)),
        "values": np.zeros(0),
        "rows": np.zeros((0, n)),
        "limits": np.zeros(0),
        "cones": np.zeros((0, 3, n)),
    }
    return Program(np.ones(n), -np.array(point), **(fields | parts))


@given(st.tuples(*[st.floats(-3, 3)] * 3))
def test_the_closest_point_of_a_cone_is_known(point):
    p = np.array(point)
    t, x = p[0], p[1:]
    size = float(np.linalg.norm(x))
    if size <= t:
        expected = p
    elif size <= -t:
        expected = np.zeros(3)
    else:
        expected = 0.5 * (t + size) * np.array([1.0, *(x / size)])
    found = by_clarabel(nearest(p, cones=np.eye(3)[None]))
    assert found == pytest.approx(expected, abs=2e-5)


@given(st.integers(0, 300))
def test_another_solver_of_another_kind_has_the_same_answer(seed):
    rng = np.random.default_rng(seed)
    n, k = int(rng.integers(2, 7)), int(rng.integers(0, 9))
    inside, weights = rng.uniform(-0.5, 0.5, n), rng.uniform(0.1, 3.0, n)
    rows, equal = rng.normal(size=(k, n)), rng.normal(size=(1, n))
    limits, values = rows @ inside + rng.uniform(0.0, 0.5, k), equal @ inside
    linear = rng.normal(size=n)
    program = Program(weights, linear, equal, values, rows, limits, np.zeros((0, 3, n)))
    above, below = np.concatenate([values, limits]), np.concatenate([values, np.full(k, -1e30)])
    senses = np.array([5] + [0] * k, dtype=np.int32)  # the first is an equality
    other, _, flag, _ = daqp.solve(np.diag(weights), linear, np.vstack([equal, rows]), above, below, senses)
    assert flag > 0
    np.testing.assert_allclose(by_clarabel(program), other, atol=1e-6)


def test_what_has_no_answer_is_said_to_have_none():
    rows, limits = np.array([[1.0], [-1.0]]), np.array([-1.0, -1.0])
    assert by_clarabel(nearest([0.0], rows=rows, limits=limits)) == "infeasible"
    assert by_clarabel(nearest([0.0], equal=rows, values=limits)) == "infeasible"
    assert by_clarabel(nearest([0.0], rows=rows, limits=np.array([-1.0, np.inf]))) == pytest.approx([-1.0])


@pytest.mark.parametrize("part", ["equal", "values", "rows", "limits", "cones"])
def test_what_is_no_number_is_failed_and_not_infeasible(part):
    rows = np.array([[1.0], [-1.0]])
    parts = {"equal": rows[:1], "values": np.ones(1), "rows": rows, "limits": np.ones(2)}
    parts["cones"] = np.ones((1, 3, 1))
    parts[part].flat[0] = np.nan
    assert by_clarabel(nearest([0.0], **parts)) == "failed"
