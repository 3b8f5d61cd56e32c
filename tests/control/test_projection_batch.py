"""project_batch beside project, problem by problem."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, UnknownNameError
from safe_wrappers.filter import batch
from safe_wrappers.filter.projection import project, project_unchecked

FINITE = st.one_of(st.just(0.0), st.floats(-3, 3).map(lambda v: round(v, 3)))
BOUNDS = st.sampled_from(
    [(-1.0, 1.0), (-1.0, 1.0), (0.0, 0.0), (-0.5, 2.0), (-100.0, 50.0), (-math.inf, math.inf)]
)
SCALE = st.sampled_from([1.0, 1.0, 1e-5, 1e6])


@st.composite
def batches(draw):
    count, rows, size = draw(st.integers(1, 4)), draw(st.integers(0, 4)), draw(st.integers(1, 3))
    scale = np.array(draw(st.lists(SCALE, min_size=count * rows, max_size=count * rows))).reshape(count, rows)

    def array(*shape):
        length = math.prod(shape)
        return np.array(draw(st.lists(FINITE, min_size=length, max_size=length))).reshape(shape)

    normals, offsets = array(count, rows, size) * scale[..., None], array(count, rows) * scale
    for i, j in np.ndindex(count, rows):
        if draw(st.integers(0, 5)) == 0:  # asks for nothing
            normals[i, j], offsets[i, j] = 0.0, math.inf
        elif draw(st.integers(0, 30)) == 0:
            offsets[i, j] = draw(st.sampled_from([math.nan, -math.inf]))
    low, high = np.array([[draw(BOUNDS) for _ in range(size)] for _ in range(count)]).transpose(2, 0, 1)
    return array(count, size), normals, offsets, low, high


def compare(problems):
    """Every answer of the batch is that of `project`: statuses the same, controls to 1e-12 of the box."""
    answer = sw.project_batch(*problems)
    for i, problem in enumerate(zip(*problems, strict=True)):
        single = project(*problem)
        assert answer.status[i] == single.status
        u, normals, offsets, low, high = problem
        if single.status == "inactive":
            assert answer.controls[i].tobytes() == u.tobytes()
        width = np.where(np.isfinite(high - low), np.maximum(high - low, np.abs(low) + np.abs(high)), 1.0)
        numbers = np.abs(u).max() + np.abs(single.control).max()
        assert (np.abs(answer.controls[i] - single.control) <= 1e-12 * np.maximum(width, numbers)).all()
        assert ((low <= answer.controls[i]) & (answer.controls[i] <= high)).all()
        rows = np.where(offsets < math.inf, np.linalg.norm(normals, axis=1) * (1.0 + numbers), 0.0)
        assert answer.violation[i] == pytest.approx(
            single.violation, abs=1e-12 * (1.0 + rows.max(initial=0.0))
        )
        scale = 1e-9 * max(1.0, single.multipliers.max(initial=0.0))
        np.testing.assert_allclose(answer.multipliers[i], single.multipliers, atol=scale)
    return answer


@given(batches())
def test_every_answer_is_that_of_project(problems):
    compare(problems)


@pytest.mark.parametrize("size", [1, 2, 6, 17])
@pytest.mark.parametrize("rows", [1, 2, 8])
def test_random_batches_of_every_status(size, rows):
    rng = np.random.default_rng([size, rows])
    normals = rng.normal(size=(200, rows, size)) * 10.0 ** rng.uniform(-2, 2, (200, rows, 1))
    length = np.linalg.norm(normals, axis=2)
    offsets = length * (rng.normal(size=(200, rows)) + rng.uniform(-2.0, 2.0, (200, 1)))
    low = rng.uniform(-2.0, 0.0, (200, size))
    answer = compare(
        (rng.uniform(-2, 2, (200, size)), normals, offsets, low, low + rng.uniform(0.5, 3, (200, size)))
    )
    assert {"projected", "infeasible"} <= set(answer.status)


def test_rows_that_ask_for_nothing_change_nothing():
    u, normals, offsets = np.array([[0.9, 0.9]] * 2), np.zeros((2, 3, 2)), np.full((2, 3), math.inf)
    normals[0, 0], offsets[0, 0] = [1.0, 0.0], 0.2
    answer = sw.project_batch(u, normals, offsets, [-1.0, -1.0], [1.0, 1.0])
    assert answer.status.tolist() == ["projected", "inactive"]
    np.testing.assert_allclose(answer.controls, [[0.2, 0.9], [0.9, 0.9]], atol=1e-15)
    assert answer.multipliers.shape == (2, 3) and answer.multipliers[0, 0] == pytest.approx(0.7)


@pytest.mark.parametrize(("solver", "reach_it"), [("active-set", []), ("daqp", [1, 2])])
def test_only_problems_of_several_rows_reach_a_named_solver(monkeypatch, solver, reach_it):
    asked = []

    def counted(u, *rest):
        asked.append(u.copy())
        return project_unchecked(u, *rest)

    monkeypatch.setattr(batch, "project_unchecked", counted)
    u = np.array([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.9, 0.9]])
    normals = np.tile(np.eye(2), (4, 1, 1))
    offsets = np.array([[0.5, 0.5], [0.5, 0.5], [0.5, 0.5], [-9.0, math.inf]])
    answer = sw.project_batch(u, normals, offsets, -1.0, 1.0, solver=solver)
    assert answer.status.tolist() == ["inactive", "projected", "projected", "infeasible"]
    np.testing.assert_allclose(answer.controls, [[0.1, 0.1], [0.5, 0.1], [0.5, 0.5], [-1.0, 0.9]], atol=1e-12)
    np.testing.assert_array_equal(np.reshape(asked, (-1, 2)), u[reach_it])
    assert answer.violation[3] == 8.0


@pytest.mark.parametrize("bad", [math.nan, -math.inf, 1e200])
def test_a_row_that_cannot_be_judged_fails_its_own_problem_only(bad):
    normals, offsets = np.ones((3, 2, 1)), np.full((3, 2), 0.5)
    (offsets if bad < 0 else normals[..., 0])[1, 0] = bad
    answer = compare((np.full((3, 1), 0.9), normals, offsets, np.full((3, 1), -1.0), np.full((3, 1), 1.0)))
    assert answer.status[0] == answer.status[2] == "projected" and answer.status[1] != "inactive"


def test_arguments_are_not_written_to_and_no_memory_is_shared():
    arguments = [np.array([[0.9], [0.1]]), np.ones((2, 1, 1)), np.full((2, 1), 0.5), -np.ones(1), np.ones(1)]
    copies = [a.copy() for a in arguments]
    answer = sw.project_batch(*arguments)
    answer.controls[:] = 7.0
    for array, copy in zip(arguments, copies, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_an_empty_batch():
    answer = sw.project_batch(np.zeros((0, 2)), np.zeros((0, 3, 2)), np.zeros((0, 3)), -1.0, 1.0)
    assert (
        answer.controls.shape == (0, 2) and answer.status.shape == (0,) and answer.multipliers.shape == (0, 3)
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([0.0], [[[1.0]]], [[1.0]], -1, 1), r"expected u_nom \(B, m\)"),
        (([[0.0]], [[1.0]], [[1.0]], -1, 1), r"expected u_nom \(B, m\)"),
        (([[0.0]] * 2, [[[1.0]]], [[1.0]], -1, 1), r"expected u_nom \(B, m\)"),
        (([[0.0]], [[[1.0]]], [[1.0]], [-1.0] * 3, 1), r"expected bounds of shape \(1,\)"),
        (([[0.0], [np.nan]], np.ones((2, 1, 1)), np.ones((2, 1)), -1, 1), r"rows \[1\] are not"),
        (([[0.0]], [[[1.0]]], [[1.0]], 1, -1), "lower must not exceed upper"),
    ],
)
def test_nonsense_is_refused(arguments, message):
    with pytest.raises(ConfigurationError, match=message):
        sw.project_batch(*arguments)


def test_an_unknown_solver_is_refused():
    with pytest.raises(UnknownNameError, match="'gurobbi' is not installed"):
        sw.project_batch([[0.0]], [[[1.0]]], [[1.0]], -1, 1, solver="gurobbi")
