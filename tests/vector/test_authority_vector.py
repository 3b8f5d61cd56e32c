"""Faults, handover, lease and filter in Gymnasium's vector envs: in every mode the single envs, bit for bit."""

import contextlib
import functools

import pytest
from authority_worlds import TASKS, CarriedOn
from single_loops import assert_same_episodes, by_hand, script, unroll
from vector_worlds import KINDS, WAYS, sub_envs

SEED, STEPS = 5, 30
ENDS = {"ends": [[7, -9, 5], [-6, 8, 8], [9, 4, -7]]}
pytestmark = [
    pytest.mark.filterwarnings("ignore:the policy's action is not finite:UserWarning"),
    pytest.mark.filterwarnings("ignore:a command was held back:UserWarning"),
    pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning"),
]


def actions_for(task):
    return script(TASKS[task]().action_space, drive=None)


def options_for(task):
    return ENDS if "cart" in task else None


@functools.cache
def single(task):
    """Each task by hand once, every episode on a stack of its own; all modes are compared with the same ones."""
    make, actions = CarriedOn(TASKS[task]), actions_for(task)
    return [
        by_hand(make, actions, i, seed=SEED + i, steps=STEPS, options=options_for(task)) for i in range(3)
    ]


@pytest.mark.parametrize("task", TASKS)
def test_the_episodes_by_hand_have_in_them_what_is_to_be_compared(task):
    steps = [step for episodes in single(task) for episode in episodes for step in episode.steps]
    assert all(len(episodes) >= 3 for episodes in single(task))
    if task in ("cart", "point_goal"):
        assert any(s.info["handover/starved"] for s in steps) and any(
            s.info["handover/refused"] for s in steps
        )
        assert len({s.info["handover/starved"] for s in steps}) >= 2
    else:
        assert {s.info["lease/refused"] for s in steps} == {True, False}
    flags = ["lease/braking"]
    if task != "point_goal":  # jitter makes every chunk late
        flags.append("fault/active")
    for flag in flags:
        assert {bool(s.info[flag]) for s in steps} == {True, False}, flag


@pytest.mark.parametrize(("kind", "mode"), WAYS)
@pytest.mark.parametrize("task", TASKS)
def test_a_vector_env_is_its_single_envs(task, kind, mode):
    with contextlib.closing(KINDS[kind](sub_envs(TASKS[task]), autoreset_mode=mode)) as envs:
        episodes = unroll(envs, actions_for(task), seed=SEED, steps=STEPS, options=options_for(task))
    for i, (got, wanted) in enumerate(zip(episodes, single(task), strict=True)):
        assert assert_same_episodes(got, wanted, f"sub-env {i}, ") >= 2
