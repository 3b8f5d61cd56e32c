"""A projection that no solver has answered is called failed, and not infeasible: nothing has shown that it is."""

import daqp
import gymnasium as gym
import numpy as np
import pytest
import qpsolvers

import safe_wrappers as sw
from safe_wrappers.control.numerics import active_set, conic_program
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


# A solver that reaches its limit of iterations --------------------------------------------------------------------


def daqp_limited(asked):
    real = daqp.solve

    def solve(*arguments, **options):
        answer = real(*arguments, **options, iter_limit=1)
        asked.append(answer[2])
        return answer

    return daqp, "solve", solve


def clarabel_limited(asked):
    real = qpsolvers.solve_problem

    def solve_problem(problem, solver):
        solution = real(problem, solver=solver, max_iter=1)
        asked.append(1 if solution.found else 0)
        return solution

    return qpsolvers, "solve_problem", solve_problem


LIMITED = {"daqp": daqp_limited, "clarabel": clarabel_limited}


@pytest.mark.parametrize("solver", LIMITED)
def test_a_backend_that_reaches_its_limit_is_replaced_by_the_active_set(monkeypatch, solver):
    asked = []
    problem = [0.9, 0.8], ROWS, [0.3, 0.2], -1.0, 1.0
    right = sw.project(*problem)
    monkeypatch.setattr(*LIMITED[solver](asked))
    answer = sw.project(*problem, solver=solver)
    assert len(asked) == 1 and asked[0] < 1
    assert answer.status == "projected" and answer.control.tobytes() == right.control.tobytes()


def test_a_program_whose_solver_reaches_its_limit_is_failed_and_not_infeasible(monkeypatch):
    program = conic_program.Program(
        np.eye(2), -np.array([0.9, 0.8]), ROWS, np.array([0.3, 0.2]), np.full(2, -1.0), np.full(2, 1.0)
    )
    assert conic_program.by_daqp(program).verdict == conic_program.by_clarabel(program).verdict == "solved"
    asked, settings = [], conic_program.clarabel.DefaultSettings

    def limited():
        made = settings()
        made.max_iter = 1
        return made

    monkeypatch.setattr(*daqp_limited(asked))
    monkeypatch.setattr(conic_program.clarabel, "DefaultSettings", limited)
    assert conic_program.by_daqp(program) == conic_program.by_clarabel(program) == ("failed", None)
    assert len(asked) == 1


def test_an_active_set_that_makes_no_progress_gives_up(monkeypatch):
    rounds = []

    def nothing_changes(*given):
        rounds.append(1)
        assert len(rounds) < 1_000, "it has no limit"
        return given[6], active_set.SOLVED, 1

    monkeypatch.setattr(active_set, "_enter", nothing_changes)
    point, normals, rows, *memory = active_set.search_space(2, 2, False)
    point[:] = rows[:] = 0.0
    normals[:] = ROWS.T
    point[active_set.TARGET] = 0.9, 0.8
    point[active_set.LOW], point[active_set.HIGH] = -1.0, 1.0
    rows[active_set.OFFSET], rows[active_set.LENGTH] = (0.3, 0.2), np.linalg.norm(ROWS, axis=1)
    closest_point = getattr(active_set.closest_point, "py_func", active_set.closest_point)
    ended, steps = closest_point(point, normals, rows, *memory)
    assert ended == active_set.GAVE_UP and steps == len(rounds) == 10 * (2 + 2)


@pytest.mark.parametrize("solver", ["active-set", *LIMITED])
def test_where_every_solver_reaches_its_limit_the_filter_says_so(monkeypatch, solver):
    env = sw.CBFActionFilter(gym.make("Reacher-v5"), [sw.constraints.JointSpeedLimit(1.0)], solver=solver)
    env.reset(seed=0)
    asked, gave_up = [], []
    for limited in LIMITED.values():
        monkeypatch.setattr(*limited(asked))
    monkeypatch.setattr(projection, "keep_rows", lambda *given: (gave_up.append(1), give_up(*given))[1])
    told = []
    for _ in range(10):
        info = env.step(np.ones(2, np.float32))[4]
        told.append((len(gave_up), info["cbf/fallback"] or info["cbf/infeasible"]))
        assert np.abs(info["executed_action"]).max() <= 1.0
    assert min(asked) < 1
    assert all(said for tried, said in told if tried) and told[-1][0]
