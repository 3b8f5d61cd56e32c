"""Gymnasium's vector envs in every autoreset mode are the single envs, bit for bit, infos and all."""

import contextlib
import functools

import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from single_loops import assert_same_episodes, by_hand, script, unroll
from vector_worlds import KINDS, TASKS, WAYS, sub_envs

PIPES = {"async, pipes": functools.partial(AsyncVectorEnv, shared_memory=False)}
PLAYED = [(task, *way) for task in TASKS for way in WAYS]
PLAYED += [("cart", kind, mode) for kind in ("async", *PIPES) for mode in AutoresetMode]
SEED, STEPS = 5, 30
pytestmark = pytest.mark.filterwarnings("ignore:the policy's action is not finite:UserWarning")


def actions_for(task):
    return script(TASKS[task]().action_space, drive=0.9 if task == "point_goal" else None)


@functools.cache
def single(task):
    """Each task by hand once; all modes are compared with the same episodes."""
    actions = actions_for(task)
    return [by_hand(TASKS[task], actions, i, seed=SEED + i, steps=STEPS) for i in range(3)]


@pytest.mark.parametrize("task", TASKS)
def test_the_episodes_by_hand_have_in_them_what_is_to_be_compared(task):
    for episodes in single(task):
        whole = episodes[:-1]
        assert len(whole) >= 2
        steps = [step for episode in whole for step in episode.steps]
        assert any(s.info["cbf/intervened"] and not s.info["cbf/nonfinite"] for s in steps)
        assert any(not s.info["cbf/intervened"] for s in steps)
        for episode in whole:
            summaries = ["interventions" in step.info for step in episode.steps]
            assert summaries == [False] * (len(summaries) - 1) + [True]
        # The filter holds the last executed action; a new episode has none.
        assert all(not e.steps[0].info["executed_action"].any() for e in whole[1:] if not odd(e.steps[0]))
    ends = {(e.steps[-1].terminated, e.steps[-1].truncated) for es in single(task) for e in es[:-1]}
    assert ends == {"cart": {(True, False)}, "pendulum": {(True, False)}}.get(task, {(False, True)})


def odd(step):
    """The filter had to move even the held zero."""
    return step.info["cbf/infeasible"] or step.info["cbf/unsafe"]


@pytest.mark.parametrize(("task", "kind", "mode"), dict.fromkeys(PLAYED))
def test_a_vector_env_is_its_single_envs(task, kind, mode):
    with contextlib.closing((KINDS | PIPES)[kind](sub_envs(TASKS[task]), autoreset_mode=mode)) as envs:
        episodes = unroll(envs, actions_for(task), seed=SEED, steps=STEPS)
        calls = envs.get_attr("filter_calls")
    for i, (got, wanted) in enumerate(zip(episodes, single(task), strict=True)):
        whole = assert_same_episodes(got, wanted, f"sub-env {i}, ")
        assert whole >= 2
        # An action that only triggers a reset is not filtered.
        assert calls[i] == sum(len(episode.steps) for episode in got)
    firsts = {episodes[i][0].observation.tobytes() for i in range(3)}
    assert len(firsts) == 3, "every sub-env has a seed of its own"
