"""Faults, handover, lease and filter under Stable-Baselines3's vector envs: as in single loops, bit for bit."""

import contextlib
import functools

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
from authority_worlds import TASKS, CarriedOn
from single_loops import Episode, Step, assert_same_episodes, by_hand, script
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


def unroll(envs, actions):
    """The episodes of every sub-env; without Monitor's wall-clock time."""
    envs.seed(SEED)
    observations = envs.reset()
    episodes = [[Episode(o, told)] for o, told in zip(observations, envs.reset_infos, strict=True)]
    for _ in range(STEPS):
        proposed = [actions(i, len(e) - 1, len(e[-1].steps)) for i, e in enumerate(episodes)]
        observations, rewards, dones, infos = envs.step(np.stack(proposed))
        for i in range(envs.num_envs):
            info = dict(infos[i])
            truncated = info.pop("TimeLimit.truncated")
            last = info.pop("terminal_observation") if dones[i] else observations[i]
            episodes[i][-1].steps.append(Step(last, rewards[i], dones[i] and not truncated, truncated, info))
            if dones[i]:
                episodes[i].append(Episode(observations[i], envs.reset_infos[i]))
    return without_time(episodes)


def without_time(all_episodes):
    for step in (step for episodes in all_episodes for episode in episodes for step in episode.steps):
        step.info.get("episode", {}).pop("t", None)
        step.reward = np.float32(step.reward)
    return all_episodes


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("task", TASKS)
def test_a_vec_env_is_its_single_envs(task, kind):
    with contextlib.closing(KINDS[kind]([functools.partial(monitored, task, i) for i in range(3)])) as envs:
        actions = script(envs.action_space)
        episodes = unroll(envs, actions)
    make = CarriedOn(functools.partial(monitored, task))
    wanted = without_time([by_hand(make, actions, i, seed=SEED + i, steps=STEPS) for i in range(3)])
    for i in range(3):
        assert assert_same_episodes(episodes[i], wanted[i], f"sub-env {i}, ", types=True) >= 1
        for episode in episodes[i][:-1]:
            end = episode.steps[-1].info
            assert end["episode"]["lease/braking"] == end["lease/braking"]
