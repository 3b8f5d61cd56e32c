"""Vector envs of Gymnasium are the single envs, bit for bit, infos and all, in every autoreset mode and process.

A vector env's stream is unrolled into the episodes that it was made of; these must be the episodes of single envs
that are driven by hand. That a stack forgets what it should at a reset is for tests/contract.
"""

import contextlib
import functools
from typing import NamedTuple

import numpy as np
import pytest
from episodes import plain
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from vector_worlds import TASKS, cart_filter, sub_envs

from safe_wrappers.errors import ConfigurationError

SEED, STEPS = 5, 30
pytestmark = [
    pytest.mark.filterwarnings("ignore:the policy's action is not finite:UserWarning"),
    pytest.mark.filterwarnings("ignore:a command was held back:UserWarning"),
    pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning"),
    # Gymnasium logs a process's error as a warning before it raises it.
    pytest.mark.filterwarnings("ignore:.*ERROR:UserWarning"),
]
SEEN = {
    "cart": ["cbf/intervened", "cbf/unsafe", "cbf/nonfinite"],
    "point_goal": ["cbf/intervened", "cbf/nonfinite"],
    "reacher": ["cbf/intervened", "cbf/nonfinite"],
    "rover": ["cbf/intervened", "cbf/nonfinite"],
    "commanded_cart": ["lease/braking", "fault/active", "handover/refused"],
    "occluded": ["cbf/intervened", "cbf/nonfinite"],
}
"""Flags that the episodes by hand must raise at times, and at others not."""
OPTIONS = {"commanded_cart": {"ends": [[7, -9, 5], [-6, 8, 8], [9, 4, -7]]}}


class Episode(NamedTuple):
    """What reset and steps returned, as bytes and plain values."""

    start: tuple
    steps: list


def script(task, seed=0):
    """Actions by sub-env, episode and step, so that every mode plays the same episodes.

    Bang-bang, held for three steps; the first action of every later episode is not finite, so that the fallback
    "hold" shows what the filter remembers. The first control is mostly full ahead where a hazard is there.
    """
    space, ahead = TASKS[task]().action_space, 0.9 if task == "point_goal" else 0.5

    def action(i, k, t):
        if k and not t:
            return np.full(space.shape, np.nan, space.dtype)
        shares = np.random.default_rng([seed, i, k, t // 3]).uniform(size=space.shape)
        signs = shares < np.append(ahead, np.full(shares.size - 1, 0.5)).reshape(space.shape)
        return np.where(signs, space.high, space.low).astype(space.dtype)

    return action


@functools.cache
def by_hand(task):
    """Each sub-env's episodes, reset where one ends, once; all vector envs are compared with the same ones."""
    actions, found = script(task), []
    for i in range(3):
        env, episodes, options = TASKS[task](i), [], {"seed": SEED + i, "options": OPTIONS.get(task)}
        while sum(len(episode.steps) for episode in episodes) <= STEPS:
            episodes.append(Episode(env.reset(**options), []))
            options, over = {}, False
            while not over:
                action = actions(i, len(episodes) - 1, len(episodes[-1].steps))
                observation, reward, *ends, info = env.step(action)
                episodes[-1].steps.append((observation, float(reward), *ends, info))
                over = any(ends)
        found.append(episodes)
    return found


def rows(infos, n):
    """A vector env's infos, one dict per sub-env, by the masks; refuses what has no mask or a vague dtype."""
    told = [{} for _ in range(n)]
    for key, values in infos.items():
        if key.startswith("_") and key[1:] in infos:
            continue
        mask = infos[f"_{key}"]
        assert mask.dtype == np.bool_ and mask.shape == (n,), key
        if isinstance(values, dict):
            values = rows(values, n)
        assert len(values) == n and (isinstance(values, list) or values.dtype != object or key == "final_obs")
        for i in np.flatnonzero(mask):
            told[i][key] = values[i]
    return told


def unroll(envs, actions, options=None):
    """The episodes of every sub-env of a vector env, in any autoreset mode."""
    mode, n = envs.metadata["autoreset_mode"], envs.num_envs
    observations, infos = envs.reset(seed=SEED, options=options)
    episodes = [[Episode((o, told), [])] for o, told in zip(observations, rows(infos, n), strict=True)]
    resets = np.zeros(n, bool)
    for _ in range(STEPS):
        proposed = [actions(i, len(e) - 1, len(e[-1].steps)) for i, e in enumerate(episodes)]
        # What is sent to a sub-env that will only reset must not matter at all.
        proposed = [np.full_like(a, np.inf) if resets[i] else a for i, a in enumerate(proposed)]
        observations, rewards, terminated, truncated, infos = envs.step(np.stack(proposed))
        ended = terminated | truncated
        for i, told in enumerate(rows(infos, n)):
            if resets[i]:
                assert rewards[i] == 0.0 and not ended[i]
                episodes[i].append(Episode((observations[i], told), []))
                continue
            again = mode is AutoresetMode.SAME_STEP and ended[i]
            last = (told.pop("final_obs"), told.pop("final_info")) if again else (observations[i], told)
            episodes[i][-1].steps.append((last[0], rewards[i], terminated[i], truncated[i], last[1]))
            if again:
                episodes[i].append(Episode((observations[i], told), []))
        if mode is AutoresetMode.NEXT_STEP:
            resets = ended
        elif mode is AutoresetMode.DISABLED and ended.any():
            observations, infos = envs.reset(options={"reset_mask": ended})
            told = rows(infos, n)
            assert not any(told[i] for i in np.flatnonzero(~ended))
            for i in np.flatnonzero(ended):
                episodes[i].append(Episode((observations[i], told[i]), []))
    return episodes


def bits(value):
    """What compares bit for bit, with the dtypes that numbers have in an array."""
    if isinstance(value, dict):
        return {key: bits(one) for key, one in value.items()}
    if isinstance(value, tuple):
        return tuple(map(bits, value))
    array = np.asarray(value)
    return array.dtype, plain(array)


@pytest.mark.parametrize("task", TASKS)
def test_the_episodes_by_hand_have_in_them_what_is_to_be_compared(task):
    assert all(len(episodes) >= 3 for episodes in by_hand(task))
    whole = [episode for episodes in by_hand(task) for episode in episodes[:-1]]
    for flag in SEEN[task]:
        assert {bool(step[4][flag]) for episode in whole for step in episode.steps} == {True, False}, flag
    for episode in whole:
        summaries = ["interventions" in step[4] for step in episode.steps]
        assert summaries == [False] * (len(summaries) - 1) + [True]
    ends = {episode.steps[-1][2:4] for episode in whole}
    assert task != "commanded_cart" or ends == {(True, False), (False, True)}


SYNC, FORKED = SyncVectorEnv, functools.partial(AsyncVectorEnv, context="fork")
SPAWNED = functools.partial(AsyncVectorEnv, context="spawn")  # from nothing
# Processes send what any env says: the mode that says most at once is enough.
PLAYED = {f"{task}, {mode.value}": (task, SYNC, mode) for task in TASKS for mode in AutoresetMode}
PLAYED |= {f"{task}, forked": (task, FORKED, AutoresetMode.SAME_STEP) for task in ("cart", "occluded")}
PLAYED["point_goal, spawned"] = "point_goal", SPAWNED, AutoresetMode.SAME_STEP


@pytest.mark.parametrize(("task", "kind", "mode"), PLAYED.values(), ids=PLAYED)
def test_a_vector_env_is_its_single_envs(task, kind, mode):
    count = 1 if kind is SPAWNED else 3
    with contextlib.closing(kind(sub_envs(TASKS[task], count), autoreset_mode=mode)) as envs:
        found = unroll(envs, script(task), OPTIONS.get(task))
        calls = envs.get_attr("filter_calls") if task in ("cart", "point_goal") else (None,) * 3
    for episodes, expected, filtered in zip(found, by_hand(task), calls, strict=False):
        assert 3 <= len(episodes) <= len(expected)
        for k, (episode, alone) in enumerate(zip(episodes, expected, strict=False)):
            steps = alone.steps if k < len(episodes) - 1 else alone.steps[: len(episode.steps)]
            assert bits(episode.start) == bits(alone.start)
            assert [bits(step) for step in episode.steps] == [bits(step) for step in steps]
        # An action that only triggers a reset is not filtered.
        assert filtered is None or filtered == sum(len(episode.steps) for episode in episodes)
    firsts = {plain(episodes[0].start[0]) for episodes in found}
    assert len(firsts) == count, "every sub-env has a seed of its own"


def test_the_filters_attributes_are_read_across_processes():
    with contextlib.closing(FORKED(sub_envs(TASKS["point_goal"], 2))) as envs:
        envs.reset(seed=0)
        assert (envs.get_attr("filter_calls"), envs.get_attr("filter_time_us")) == ((0, 0), (None, None))
        for _ in range(3):
            envs.step(envs.action_space.sample())
        assert envs.get_attr("filter_calls") == (3, 3)
        assert all(0.0 < seconds < 3.0 for seconds in envs.get_attr("filter_seconds"))
        assert all(us > 0.0 for us in envs.call("filter_time_us"))
        assert envs.get_attr("constraint_names") == (["HeadingDriveClearance"],) * 2
        assert [one.promise for (one,) in envs.get_attr("constraints")] == ["proved"] * 2
        envs.set_attr("filter_calls", [10, 20])
        envs.step(envs.action_space.sample())
        assert envs.get_attr("filter_calls") == (11, 21)


def test_a_refusal_in_a_process_arrives_as_ours_with_its_words():
    def make(index):
        return cart_filter(index, fallback=(lambda plant: [0.0, 0.0]) if index == 1 else "brake")

    envs = FORKED(sub_envs(make))
    try:
        envs.reset(seed=0, options={"start": [-1.0, 0.0]})
        with pytest.raises(ConfigurationError, match=r"must return a control of shape \(1,\), got \(2,\)"):
            envs.step(np.full((3, 1), np.nan, np.float32))
    finally:
        envs.close(terminate=True)
