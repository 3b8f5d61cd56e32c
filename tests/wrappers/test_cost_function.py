import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers import info as keys


def tip_speed(env):
    """Above 0 once the pendulum turns faster than 1 rad/s."""
    return max(0.0, abs(env.state[1]) - 1.0)


def is_fast(env):
    return bool(abs(env.state[1]) > 1.0)


class HasCalls:
    """A function that cannot be imported by a name."""

    def __call__(self, env):
        return 0.5


def pendulum(fn, steps=30):
    return sw.CostFunction(gym.make("Pendulum-v1", max_episode_steps=steps), fn)


def drive(env, steps=30):
    env.reset(seed=0)
    return [env.step(env.action_space.high) for _ in range(steps)]


@pytest.mark.parametrize("fn", [tip_speed, f"{__name__}:tip_speed"])
def test_the_cost_is_judged_on_the_true_state_after_the_step(fn):
    # The observation holds the speed of the state that the step has led to.
    env, bare = pendulum(fn), gym.make("Pendulum-v1", max_episode_steps=30)
    start, info = env.reset(seed=0)
    assert info[keys.COST] == pytest.approx(max(0.0, abs(start[2]) - 1.0), abs=1e-6)
    costs = []
    for (observation, reward, *_, info), expected in zip(drive(env), drive(bare), strict=True):
        assert type(info[keys.COST]) is float and keys.COST_SUBSTEP not in info
        assert info[keys.COST] == pytest.approx(max(0.0, abs(observation[2]) - 1.0), abs=1e-6)
        np.testing.assert_array_equal(observation, expected[0])
        assert reward == expected[1]
        costs.append(info[keys.COST])
    assert min(costs) == 0.0 and max(costs) > 1.0


def test_a_recorder_outside_counts_it_as_the_task_s_own():
    infos = [step[4] for step in drive(sw.RecordInterventions(pendulum(is_fast)))]
    hits = sum(info[keys.COST] for info in infos)
    assert 5 < hits < 30
    summary = infos[-1][keys.EPISODE_SUMMARY]
    assert summary["violations"] == summary["cost"] == hits
    assert "cost_substep" not in summary


def test_what_cannot_be_imported_is_still_rebuilt_by_gym_make():
    assert drive(gym.make(pendulum(HasCalls()).spec), 1)[0][4] == {keys.COST: 0.5}
    assert drive(gym.make(pendulum(lambda env: 2).spec), 1)[0][4] == {keys.COST: 2.0}


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), None, "1", [1.0], np.zeros(2), 1j])
def test_what_is_no_finite_number_is_refused(bad):
    env = pendulum(lambda env: bad)
    with pytest.raises(sw.SafeWrappersError, match="must return one finite number, got"):
        env.reset(seed=0)


@pytest.mark.parametrize(
    ("fn", "message"),
    [
        (3, "or its name 'module:function'; got 3"),
        ("math", "or its name 'module:function'; got 'math'"),
        ("math:pi", "got 'math:pi'"),
        ("no_such_module:cost", "cannot be imported: No module named 'no_such_module'"),
        ("math:no_such", "cannot be imported: module 'math' has no attribute 'no_such'"),
        ("a b:c", "cannot be imported"),
    ],
)
def test_what_is_no_function_is_refused(fn, message):
    with pytest.raises(sw.SafeWrappersError, match=message):
        pendulum(fn)


def test_a_task_s_own_cost_is_not_hidden():
    env = sw.CostFunction(gym.make("SafePointGoal1-v0"), lambda env: 0.0)
    with pytest.raises(sw.SafeWrappersError, match="reports a cost of its own"):
        drive(env, 1)


def test_it_judges_control_steps_and_only_once():
    with pytest.raises(sw.SafeWrappersError, match="has a CostFunction already"):
        sw.CostFunction(pendulum(tip_speed), is_fast)
    chunked = sw.ChunkHandover(gym.make("Reacher-v5"), 5, 3)
    with pytest.raises(sw.SafeWrappersError, match=r"ChunkHandover\(CostFunction"):
        sw.CostFunction(chunked, lambda env: 0.0)
    with pytest.raises(sw.SafeWrappersError, match=r"RecordInterventions\(CostFunction"):
        sw.CostFunction(sw.RecordInterventions(gym.make("Reacher-v5")), lambda env: 0.0)
    inside = sw.ChunkHandover(sw.CostFunction(gym.make("Reacher-v5"), lambda env: 1.0), 5, 3)
    inside.reset(seed=0)
    assert inside.step(inside.action_space.low)[4][keys.COST] == 3.0  # of three control steps
