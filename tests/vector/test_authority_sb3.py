"""Faults, handover, lease and filter under Stable-Baselines3's vector envs: as in single loops, bit for bit."""

import contextlib
import functools

import pytest

pytest.importorskip("stable_baselines3")
from authority_worlds import TASKS, CarriedOn
from sb3_loops import assert_same, unroll
from single_loops import by_hand, script
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

SEED, STEPS = 5, 24
KINDS = {"dummy": DummyVecEnv, "subproc": functools.partial(SubprocVecEnv, start_method="fork")}
KEYWORDS = ("lease/braking", "lease/remaining_s", "fault/active", "interventions/rate")
pytestmark = [
    pytest.mark.filterwarnings("ignore:the policy's action is not finite:UserWarning"),
    pytest.mark.filterwarnings("ignore:a command was held back:UserWarning"),
    pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning"),
]


def monitored(task, index):
    return Monitor(TASKS[task](index), info_keywords=KEYWORDS)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("task", TASKS)
def test_a_vec_env_is_its_single_envs(task, kind):
    with contextlib.closing(KINDS[kind]([functools.partial(monitored, task, i) for i in range(3)])) as envs:
        actions = script(envs.action_space)
        episodes = unroll(envs, actions, seed=SEED, steps=STEPS)
    make = CarriedOn(functools.partial(monitored, task))
    for i in range(3):
        wanted = by_hand(make, actions, i, seed=SEED + i, steps=STEPS)
        assert assert_same(episodes[i], wanted, kind, f"sub-env {i}, ") >= 1
        for episode in episodes[i][:-1]:
            end = episode.steps[-1].info
            assert end["episode"]["lease/braking"] == end["lease/braking"]
