"""Counts of interventions and costs, and a cost for tasks that have none."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.wrappers.recording import COLUMNS, RecordInterventions


class Scripted(gym.Wrapper):
    """Stands for a filter and a task: writes the infos it was given, one per step."""

    def __init__(self, env, infos):
        super().__init__(env)
        self.infos = infos
        self.filter_seconds = 0.0
        self.filter_calls = 0

    def reset(self, *, seed=None, options=None):
        self.at = 0
        self.seen = (seed, options)
        return self.env.reset(seed=seed, options=options)

    def step(self, action):
        observation, reward, terminated, truncated, _ = self.env.step(action)
        self.filter_seconds += 5e-6
        self.filter_calls += 1
        info = dict(self.infos[self.at])
        self.at += 1
        return observation, reward, terminated, truncated, info


def cbf(intervened=False, correction=0.0, margin=1.0, infeasible=False, fallback=False, unsafe=False, **task):
    return {
        keys.CBF_INTERVENED: intervened,
        keys.CBF_CORRECTION: correction,
        keys.CBF_MARGIN: margin,
        keys.CBF_INFEASIBLE: infeasible,
        keys.CBF_FALLBACK: fallback,
        keys.CBF_NONFINITE: False,
        keys.CBF_UNSAFE: unsafe,
        **task,
    }


def lease(refused=False, braking=False):
    return {keys.LEASE_REFUSED: refused, keys.LEASE_BRAKING: braking}


SCRIPT = [
    cbf(cost=0.0, cost_substep=0.0, goals_reached=0),
    cbf(True, 0.5, 0.2, cost=0.0, cost_substep=1.0, goals_reached=1, **lease(braking=True)),
    cbf(
        True,
        1.5,
        -0.1,
        infeasible=True,
        fallback=True,
        unsafe=True,
        cost=1.0,
        cost_substep=1.0,
        goals_reached=1,
        **lease(refused=True, braking=True),
    ),
    cbf(margin=float("inf"), cost=0.0, cost_substep=0.0, goals_reached=2, is_success=True),
]


def scripted_env(infos=SCRIPT):
    return RecordInterventions(Scripted(gym.make("Pendulum-v1", max_episode_steps=len(infos)), infos))


def play(env, seed=0):
    env.reset(seed=seed)
    infos, total, done = [], 0.0, False
    while not done:
        _, reward, terminated, truncated, info = env.step(np.zeros(env.action_space.shape, np.float32))
        infos.append(info)
        total += reward
        done = terminated or truncated
    return infos, total


def test_counts_of_an_episode():
    infos, total = play(scripted_env())
    assert [keys.EPISODE_SUMMARY in info for info in infos] == [False, False, False, True]
    summary = infos[-1][keys.EPISODE_SUMMARY]
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
    # Of a task without wheels, cars and tracks, and without StuckEscape.
    assert summary.keys() == set(COLUMNS) - {
        "stuck",
        "mismatch",
        "spin_outs",
        "collisions",
        "seen",
    }


def test_what_neither_the_stack_nor_the_task_reports_is_never_zero():
    env = RecordInterventions(gym.make("Pendulum-v1", max_episode_steps=3))
    infos, _ = play(env)
    assert infos[-1][keys.EPISODE_SUMMARY].keys() == {"length", "return"}
    assert env.filter_time_us is None


def test_a_layer_s_zeros_appear_only_with_the_layer():
    filtered = RecordInterventions(sw.protect(gym.make("SafePointGoal1-v0", max_episode_steps=3)))
    summary = play(filtered)[0][-1][keys.EPISODE_SUMMARY]
    assert {"infeasible", "fallback", "unsafe", "cost", "violations"} <= summary.keys()
    assert not any(name.startswith("lease") for name in summary)
    judged = play(RecordInterventions(gym.make("SafePointGoal1-v0", max_episode_steps=3)))[0][-1]
    assert judged[keys.EPISODE_SUMMARY]["violations"] == 0
    assert "infeasible" not in judged[keys.EPISODE_SUMMARY]


@pytest.mark.parametrize(
    ("costs", "violations", "cost"),
    [
        ((0.0, 0.0), 0, 0.0),
        ((0.0, None), None, None),  # the step without a cost may have been a violation
        ((None, 2.0), 1, 2.0),  # there was one at least
        ((float("nan"), 0.0), None, None),
        ((0.0, float("nan")), None, None),
    ],
)
def test_a_zero_needs_a_judgement_of_every_step(costs, violations, cost):
    infos, _ = play(scripted_env(infos=[{} if c is None else {"cost": c} for c in costs]))
    summary = infos[-1][keys.EPISODE_SUMMARY]
    assert (summary.get("violations"), summary.get("cost")) == (violations, cost)


def test_what_is_not_judged_equals_itself_also_in_another_process():
    # check_env compares the infos of two equal runs by ==.
    again = pickle.loads(pickle.dumps(copy.deepcopy(keys.NOT_JUDGED)))
    assert again is keys.NOT_JUDGED and again == keys.NOT_JUDGED and float("nan") == keys.NOT_JUDGED
    assert keys.NOT_JUDGED != 0.0 and keys.NOT_JUDGED != "nan" and np.isnan(keys.NOT_JUDGED)
    assert len({keys.NOT_JUDGED, again}) == 1


@pytest.mark.parametrize("mode", list(gym.vector.AutoresetMode))
def test_vector_env_counts_episodes_apart_in_every_autoreset_mode(mode):
    envs = gym.vector.SyncVectorEnv([scripted_env] * 2, autoreset_mode=mode)
    envs.reset(seed=0)
    ends = 0
    for _ in range(12):
        _, _, _, truncated, info = envs.step(np.zeros((2, 1), np.float32))
        info = info.get("final_info", info) if truncated.any() else info
        if truncated.any():
            ends += 1
            assert info[keys.EPISODE_SUMMARY]["length"].tolist() == [4, 4]
            if mode is gym.vector.AutoresetMode.DISABLED:
                envs.reset(options={"reset_mask": truncated})
    assert ends >= 2


def tip_speed(env):
    """Above 0 once the pendulum turns faster than 1 rad/s."""
    return max(0.0, abs(env.state[1]) - 1.0)


def is_fast(env):
    return bool(abs(env.state[1]) > 1.0)


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


def test_a_task_s_own_cost_is_not_hidden():
    env = sw.CostFunction(gym.make("SafePointGoal1-v0"), lambda env: 0.0)
    with pytest.raises(sw.SafeWrappersError, match="reports a cost of its own"):
        drive(env, 1)
