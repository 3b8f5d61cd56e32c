"""Counts of interventions and costs, and a cost for tasks that have none."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.wrappers.recording import COLUMNS


class Scripted(gym.Wrapper):
    """Stands for a filter and a task: writes the infos that it was given, one per step."""

    filter_seconds, filter_calls = 0.0, 0

    def __init__(self, infos):
        super().__init__(gym.make("Pendulum-v1", max_episode_steps=len(infos)))
        self.infos = infos

    def reset(self, **options):
        self.left = iter(self.infos)
        return self.env.reset(**options)

    def step(self, action):
        self.filter_seconds += 5e-6
        self.filter_calls += 1
        return *self.env.step(action)[:4], dict(next(self.left))


def cbf(intervened=False, correction=0.0, margin=1.0, failed=False, **task):
    told = {keys.CBF_INTERVENED: intervened, keys.CBF_CORRECTION: correction, keys.CBF_MARGIN: margin}
    told |= dict.fromkeys((keys.CBF_INFEASIBLE, keys.CBF_FALLBACK, keys.CBF_UNSAFE), failed)
    return told | {keys.CBF_NONFINITE: False, **task}


def lease(refused, braking):
    return {keys.LEASE_REFUSED: refused, keys.LEASE_BRAKING: braking}


SCRIPT = [
    cbf(cost=0.0, cost_substep=0.0, goals_reached=0),
    cbf(True, 0.5, 0.2, cost=0.0, cost_substep=1.0, goals_reached=1, **lease(False, True)),
    cbf(True, 1.5, -0.1, True, cost=1.0, cost_substep=1.0, goals_reached=1, **lease(True, True)),
    cbf(margin=float("inf"), cost=0.0, cost_substep=0.0, goals_reached=2, is_success=True),
]


def recorded(infos=SCRIPT):
    return sw.RecordInterventions(Scripted(infos))


def play(env):
    """Whether each step had a summary, the last one, and the sum of rewards."""
    env.reset(seed=0)
    found, total, done = [], 0.0, False
    while not done:
        _, reward, terminated, truncated, info = env.step(np.zeros(env.action_space.shape, np.float32))
        found.append(info.get(keys.EPISODE_SUMMARY))
        total += reward
        done = terminated or truncated
    return [one is not None for one in found], found[-1], total


def test_counts_of_an_episode():
    env = recorded()
    for _ in range(2):  # the second one is counted anew
        told, summary, total = play(env)
        assert told == [False, False, False, True]
        assert summary == {
            "length": 4,
            "return": pytest.approx(total),
            "intervention_rate": 0.5,
            "correction_mean": 0.5,
            "correction_p95": pytest.approx(np.percentile([0.0, 0.5, 1.5, 0.0], 95)),
            "infeasible": 1,
            "fallback": 1,
            "nonfinite": 0,
            "unsafe": 1,
            "lease_refused": 1,
            "lease_braking": 2,
            "margin_min": -0.1,
            "violations": 2,
            "cost": 1.0,
            "cost_substep": 2.0,
            "goals_reached": 2,
            "success": True,
        }
    # Of a task without wheels, cars and tracks, and without StuckMonitor.
    assert summary.keys() == set(COLUMNS) - {"stuck", "mismatch", "spin_outs", "collisions", "seen"}
    assert env.filter_time_us == pytest.approx(5.0)


@pytest.mark.parametrize(
    ("task", "reported"),
    [
        (lambda: gym.make("Pendulum-v1", max_episode_steps=3), set()),
        (lambda: gym.make("SafePointGoal1-v0", max_episode_steps=3), {"cost", "violations"}),
        (
            lambda: sw.protect(gym.make("SafePointGoal1-v0", max_episode_steps=3)),
            {"cost", "violations", "infeasible", "fallback", "unsafe", "mismatch", "intervention_rate"},
        ),
    ],
    ids=["bare", "with a cost", "filtered"],
)
def test_a_zero_is_of_what_the_task_or_the_stack_reports_and_else_missing(task, reported):
    env = sw.RecordInterventions(task())
    assert env.filter_time_us is None
    summary = play(env)[1]
    assert {"length", "return"} | reported <= summary.keys()
    every = {
        "cost",
        "violations",
        "infeasible",
        "fallback",
        "unsafe",
        "mismatch",
        "lease_refused",
        "stuck",
        "seen",
    }
    assert not summary.keys() & (every - reported)
    assert all(summary[name] == 0 for name in reported)
    assert 0.0 < env.filter_time_us < 1e6 if "infeasible" in reported else env.filter_time_us is None


NAN = float("nan")


@pytest.mark.parametrize(
    ("costs", "violations", "cost"),
    [
        ((0.0, 0.0), 0, 0.0),
        ((0.0, None), None, None),  # the step without a cost may have been a violation
        ((None, 2.0), 1, 2.0),  # there was one at least
        ((NAN, 0.0), None, None),
        ((0.0, NAN), None, None),
    ],
)
def test_a_zero_needs_a_judgement_of_every_step(costs, violations, cost):
    summary = play(recorded([{} if c is None else {"cost": c} for c in costs]))[1]
    assert (summary.get("violations"), summary.get("cost")) == (violations, cost)


def test_what_is_not_judged_equals_itself_also_in_another_process():
    # check_env compares the infos of two equal runs by ==.
    again = pickle.loads(pickle.dumps(copy.deepcopy(keys.NOT_JUDGED)))
    assert again is keys.NOT_JUDGED and again == keys.NOT_JUDGED and float("nan") == keys.NOT_JUDGED
    assert keys.NOT_JUDGED != 0.0 and keys.NOT_JUDGED != "nan" and np.isnan(keys.NOT_JUDGED)
    assert len({keys.NOT_JUDGED, again}) == 1


# Costs of a task that has none ------------------------------------------------------------------------------------


def excess(env):
    """Above 0 once the pendulum turns faster than 1 rad/s."""
    return max(0.0, abs(env.state[1]) - 1.0)


def is_fast(env):
    return bool(abs(env.state[1]) > 1.0)


@pytest.mark.parametrize("fn", [excess, f"{__name__}:excess", is_fast])
def test_the_cost_is_judged_on_the_true_state_after_the_step_and_counted_as_the_task_s_own(fn):
    # The observation holds the speed of the state that the step has led to.
    bare = gym.make("Pendulum-v1", max_episode_steps=30)
    env = sw.RecordInterventions(sw.CostFunction(gym.make("Pendulum-v1", max_episode_steps=30), fn))
    start, info = env.reset(seed=0)
    bare.reset(seed=0)

    def expected(observation):
        return float(abs(observation[2]) > 1.0) if fn is is_fast else max(0.0, abs(observation[2]) - 1.0)

    assert info[keys.COST] == pytest.approx(expected(start), abs=1e-6)
    costs = []
    for _ in range(30):
        observation, reward, *_, info = env.step(env.action_space.high)
        same, task, *_ = bare.step(env.action_space.high)
        assert observation.tobytes() == same.tobytes() and reward == task
        assert type(info[keys.COST]) is float and keys.COST_SUBSTEP not in info
        assert info[keys.COST] == pytest.approx(expected(observation), abs=1e-6)
        costs.append(info[keys.COST])
    summary = info[keys.EPISODE_SUMMARY]
    assert 5 < summary["violations"] == np.count_nonzero(costs) < 30 and "cost_substep" not in summary
    assert summary["cost"] == pytest.approx(sum(costs))


@pytest.mark.parametrize("answer", [None, "1", [1.0], np.zeros(2), np.nan, np.inf, 1j])
def test_a_cost_that_is_no_finite_number_is_an_error(answer):
    env = sw.CostFunction(gym.make("Pendulum-v1"), lambda env: answer)
    with pytest.raises(sw.errors.ConfigurationError, match="must return one finite number"):
        env.reset(seed=0)


def test_a_task_s_own_cost_is_not_hidden():
    env = sw.CostFunction(gym.make("SafePointGoal1-v0"), lambda env: 0.0)
    with pytest.raises(sw.errors.ConfigurationError, match="reports a cost of its own"):
        env.reset(seed=0)


class SameInfo(Scripted):
    """Hands out one dict, with one array in it, at every step."""

    def __init__(self, infos):
        super().__init__(infos)
        self.seen, self.info = np.zeros(1, bool), {}

    def step(self, action):
        *answer, info = super().step(action)
        self.seen[:] = info[keys.OCCLUSION_VISIBLE]
        self.info |= {keys.OCCLUSION_VISIBLE: self.seen, keys.COST: info[keys.COST]}
        return *answer, self.info


def test_an_env_may_write_every_step_into_the_same_info():
    script = [{keys.OCCLUSION_VISIBLE: seen, keys.COST: float(seen)} for seen in (True, True, True, False)]
    _, summary, _ = play(sw.RecordInterventions(SameInfo(script)))
    assert summary["seen"] == 0.75 and summary["cost"] == 3.0
    env = sw.ChunkHandover(SameInfo(script), 4, 4, rate_limit=1e9, fallback="zero")
    env.reset(seed=0)
    assert env.step(np.zeros((4, 1), np.float32))[4][keys.COST] == 3.0
