"""Small programs against closed forms, against each other, and against their optimality conditions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.control.whole_body import Program, by_clarabel, by_daqp


def nearest(point, **parts):
    """The program of the closest point."""
    n = len(point)
    fields = {
        "rows": np.zeros((0, n)),
        "limits": np.zeros(0),
        "lower": -np.full(n, np.inf),
        "upper": np.full(n, np.inf),
        "cones": np.zeros((0, 3, n)),
        "cone_offsets": np.zeros((0, 3)),
    }
    return Program(np.eye(n), -np.array(point), **(fields | parts))


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
    found = by_clarabel(nearest(p, cones=np.eye(3)[None], cone_offsets=np.zeros((1, 3))))
    assert found == pytest.approx(expected, abs=2e-5)


@given(st.integers(0, 300))
def test_two_backends_of_different_kinds_agree_and_the_answer_is_optimal(seed):
    rng = np.random.default_rng(seed)
    n, k = int(rng.integers(1, 7)), int(rng.integers(0, 9))
    root = rng.normal(size=(n, n))
    inside = rng.uniform(-0.5, 0.5, n)
    rows = rng.normal(size=(k, n))
    limits, box = rows @ inside + rng.uniform(0.0, 0.5, k), np.ones(n)
    no_cones = np.zeros((0, 3, n)), np.zeros((0, 3))
    program = Program(root @ root.T + np.eye(n), rng.normal(size=n), rows, limits, -box, box, *no_cones)
    one, other = by_daqp(program), by_clarabel(program)

    def value(y):
        return 0.5 * y @ program.hessian @ y + program.linear @ y

    assert value(one) == pytest.approx(value(other), rel=1e-6, abs=1e-7)
    # From the optimum no feasible direction leads down: least squares over the active normals leaves nothing.
    active = np.vstack(
        [
            rows[rows @ one > limits - 1e-7],
            np.eye(n)[one > 1 - 1e-7],
            -np.eye(n)[one < -1 + 1e-7],
        ]
    )
    gradient = program.hessian @ one + program.linear
    from scipy.optimize import nnls

    left = nnls(active.T, -gradient)[1] if len(active) else float(np.linalg.norm(gradient))
    assert left < 1e-6 * (1.0 + float(np.linalg.norm(program.linear)))


def test_what_has_no_answer_is_said_to_have_none():
    contradictory = nearest([0.0], rows=np.array([[1.0], [-1.0]]), limits=np.array([-1.0, -1.0]))
    assert by_daqp(contradictory) == by_clarabel(contradictory) == "infeasible"
