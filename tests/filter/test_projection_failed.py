"""A filter whose solvers answer nothing says so, and executes its fallback."""

import daqp
import gymnasium as gym
import numpy as np

import safe_wrappers as sw
from safe_wrappers.control import projection
from safe_wrappers.control import whole_body as conic_program


def test_a_control_beyond_the_action_s_dtype_is_cast_to_its_largest_number():
    far = np.array([1e300, -1e39, 0.5])
    no_rows = np.zeros((0, 3)), np.zeros(0)
    sent = projection.cast_inside(far, np.float32, *no_rows, np.full(3, -np.inf), np.full(3, np.inf))
    most = np.finfo(np.float32).max
    assert sent.dtype == np.float32 and sent.tolist() == [most, -most, 0.5]


def daqp_limited(asked):
    real = daqp.solve

    def solve(*arguments, **options):
        answer = real(*arguments, **options, iter_limit=1)
        asked.append(answer[2])
        return answer

    return daqp, "solve", solve


def test_a_program_whose_solver_reaches_its_limit_is_failed_and_not_infeasible(monkeypatch):
    rows = np.array([[1.0, 0.2], [-0.3, 1.0]])
    program = conic_program.Program(
        *(np.ones(2), -np.array([0.9, 0.8]), np.zeros((0, 2)), np.zeros(0), rows, np.array([0.3, 0.2])),
        np.zeros((0, 3, 2)),
    )
    assert not isinstance(conic_program.by_clarabel(program), str)
    settings = conic_program.clarabel.DefaultSettings

    def limited():
        made = settings()
        made.max_iter = 1
        return made

    monkeypatch.setattr(conic_program.clarabel, "DefaultSettings", limited)
    assert conic_program.by_clarabel(program) == "failed"


def test_where_every_solver_reaches_its_limit_the_filter_says_so(monkeypatch):
    env = sw.CBFActionFilter(gym.make("Reacher-v5"), [sw.constraints.JointSpeedLimit(1.0)])
    env.reset(seed=0)
    asked = []
    monkeypatch.setattr(*daqp_limited(asked))
    told = []
    for _ in range(10):
        info = env.step(np.ones(2, np.float32))[4]
        told.append((len(asked), info["cbf/fallback"] or info["cbf/infeasible"]))
        assert np.abs(info["executed_action"]).max() <= 1.0
    assert min(asked) < 1
    assert all(said for tried, said in told if tried) and told[-1][0]
