"""Vector envs of Gymnasium and of SB3 are the single envs, bit for bit, infos and all, in every autoreset mode."""

import contextlib
import functools

import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from single_loops import assert_same_episodes, by_hand, script, unroll, unroll_sb3
from vector_worlds import KINDS, TASKS, WAYS, sub_envs

PIPES = {"async, pipes": functools.partial(AsyncVectorEnv, shared_memory=False)}
PLAYED = [(task, *way) for task in TASKS for way in WAYS]
PLAYED += [("cart", kind, mode) for kind in ("async", *PIPES) for mode in AutoresetMode]
SEED, STEPS = 5, 30
pytestmark = [
    pytest.mark.filterwarnings("ignore:the policy's action is not finite:UserWarning"),
    pytest.mark.filterwarnings("ignore:a command was held back:UserWarning"),
    pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning"),
]
SEEN = {
    "cart": ["cbf/intervened", "cbf/unsafe", "cbf/nonfinite"],
    "point_goal": ["cbf/intervened", "cbf/nonfinite"],
    "reacher": ["cbf/intervened", "cbf/nonfinite"],
    "pendulum": ["cbf/intervened", "cbf/nonfinite"],
    "rover": ["cbf/intervened", "cbf/nonfinite"],
    "commanded_cart": ["lease/braking", "fault/active", "handover/refused"],
    "commanded_point_goal": ["lease/braking", "handover/refused"],
    "leased_pendulum": ["lease/braking", "lease/refused", "fault/active"],
    "occluded": ["cbf/intervened", "cbf/nonfinite"],
}
"""Flags that the episodes by hand must raise at times, and at others not."""


def actions_for(task):
    return script(TASKS[task]().action_space, drive=0.9 if task == "point_goal" else None)


def options_for(task):
    return {"ends": [[7, -9, 5], [-6, 8, 8], [9, 4, -7]]} if task == "commanded_cart" else None


@functools.cache
def single(task):
    """Each task by hand once; all vector envs are compared with the same episodes."""
    actions, options = actions_for(task), options_for(task)
    return [by_hand(TASKS[task], actions, i, seed=SEED + i, steps=STEPS, options=options) for i in range(3)]


@pytest.mark.parametrize("task", TASKS)
def test_the_episodes_by_hand_have_in_them_what_is_to_be_compared(task):
    assert all(len(episodes) >= 3 for episodes in single(task))
    whole = [episode for episodes in single(task) for episode in episodes[:-1]]
    steps = [step for episode in whole for step in episode.steps]
    for flag in SEEN[task]:
        assert {bool(step.info[flag]) for step in steps} == {True, False}, flag
    for episode in whole:
        summaries = ["interventions" in step.info for step in episode.steps]
        assert summaries == [False] * (len(summaries) - 1) + [True]
    ends = {(episode.steps[-1].terminated, episode.steps[-1].truncated) for episode in whole}
    wanted = {
        "cart": {(True, False)},
        "pendulum": {(True, False)},
        "commanded_cart": {(True, False), (False, True)},
    }
    assert ends == wanted.get(task, ends)


@pytest.mark.parametrize(("task", "kind", "mode"), dict.fromkeys(PLAYED))
def test_a_vector_env_is_its_single_envs(task, kind, mode):
    with contextlib.closing((KINDS | PIPES)[kind](sub_envs(TASKS[task]), autoreset_mode=mode)) as envs:
        episodes = unroll(envs, actions_for(task), seed=SEED, steps=STEPS, options=options_for(task))
        calls = envs.get_attr("filter_calls") if task in ("cart", "point_goal") else None
    for i, (got, wanted) in enumerate(zip(episodes, single(task), strict=True)):
        assert assert_same_episodes(got, wanted, f"sub-env {i}, ") >= 2
        # An action that only triggers a reset is not filtered.
        assert calls is None or calls[i] == sum(len(episode.steps) for episode in got)
    firsts = {episodes[i][0].observation.tobytes() for i in range(3)}
    assert len(firsts) == 3, "every sub-env has a seed of its own"


@pytest.mark.parametrize("kind", ["dummy", "subproc"])
@pytest.mark.parametrize("task", ["cart", "point_goal", "pendulum", "rover"])
def test_a_vec_env_of_sb3_is_its_single_envs(task, kind):
    pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

    kinds = {"dummy": DummyVecEnv, "subproc": functools.partial(SubprocVecEnv, start_method="fork")}

    def make(index):
        return Monitor(TASKS[task](index))

    actions = actions_for(task)
    with contextlib.closing(kinds[kind](sub_envs(make))) as envs:
        episodes = unroll_sb3(envs, actions, seed=SEED, steps=STEPS)
    for i, got in enumerate(episodes):
        wanted = by_hand(make, actions, i, seed=SEED + i, steps=STEPS)
        for episode in (*got, *wanted):
            for step in episode.steps:
                step.reward = (
                    np.float32(step.reward) if kind == "dummy" else step.reward
                )  # its rewards' dtype
                step.info.get("episode", {}).pop("t", None)  # Monitor's wall-clock time
        assert assert_same_episodes(got, wanted, f"sub-env {i}, ", types=True) >= 2
        for episode in got[:-1]:
            # The recorder's summary and Monitor's agree.
            info = episode.steps[-1].info
            assert info["episode"]["l"] == info["interventions"]["length"] == len(episode.steps)
            assert info["episode"]["r"] == round(info["interventions"]["return"], 6)
