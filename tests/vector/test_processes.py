"""The filter in processes of its own: made there, asked from here, gone when closed."""

import contextlib
import functools

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv
from single_loops import assert_same_episodes, by_hand, script, unroll
from vector_worlds import DT, TASKS, ScheduledCart, cart_filter, drift, push, read, sub_envs

import safe_wrappers as sw
from safe_wrappers.errors import ActionError, ConfigurationError

# Gymnasium logs a process's error as a warning before it raises it.
pytestmark = pytest.mark.filterwarnings("ignore:.*ERROR:UserWarning")


def wrong_fallback(plant):
    return [0.0, 0.0]


def with_wrong_fallback(index):
    return cart_filter(index, fallback=wrong_fallback if index == 1 else "brake")


def ahead(x):
    return 1.0 - x[0]


def with_wrong_barrier(index):
    plant = sw.AnalyticPlant(f=drift, g=push, state=read, control_dt=DT)
    return sw.CBFActionFilter(ScheduledCart(index), [sw.constraints.Barrier(ahead)], plant=plant)


@pytest.mark.parametrize("context", ["spawn", "fork"])
def test_the_same_in_a_process_that_starts_from_nothing(context):
    actions = script(TASKS["point_goal"]().action_space, drive=0.9)
    envs = AsyncVectorEnv(sub_envs(TASKS["point_goal"], 1), context=context, autoreset_mode="SameStep")
    with contextlib.closing(envs):
        episodes = unroll(envs, actions, seed=4, steps=9)
    wanted = by_hand(TASKS["point_goal"], actions, 0, seed=4, steps=9)
    assert assert_same_episodes(episodes[0], wanted) == 1


def test_the_filters_attributes_are_read_across_processes():
    with contextlib.closing(AsyncVectorEnv(sub_envs(TASKS["point_goal"], 2))) as envs:
        envs.reset(seed=0)
        assert envs.get_attr("filter_calls") == (0, 0)
        assert envs.get_attr("filter_time_us") == (None, None)
        for _ in range(3):
            envs.step(envs.action_space.sample())
        assert envs.get_attr("filter_calls") == (3, 3)
        assert all(0.0 < seconds < 3.0 for seconds in envs.get_attr("filter_seconds"))
        assert all(us > 0.0 for us in envs.call("filter_time_us"))
        assert envs.get_attr("constraint_names") == (["HeadingDriveClearance"],) * 2
        for constraints in envs.get_attr("constraints"):
            assert constraints[0].promise == "proved" and constraints[0].margin == 0.004
        envs.set_attr("filter_calls", [10, 20])
        envs.step(envs.action_space.sample())
        assert envs.get_attr("filter_calls") == (11, 21)


def test_a_refusal_in_a_process_arrives_as_ours_with_its_words():
    envs = AsyncVectorEnv([functools.partial(with_wrong_fallback, i) for i in range(3)])
    try:
        envs.reset(seed=0, options={"start": [-1.0, 0.0]})
        with pytest.raises(ConfigurationError, match=r"must return a control of shape \(1,\), got \(2,\)"):
            envs.step(np.full((3, 1), np.nan, np.float32))
    finally:
        envs.close(terminate=True)
    envs = AsyncVectorEnv(sub_envs(with_wrong_barrier, 2))
    try:
        with pytest.raises(ConfigurationError, match="relative degree"):
            envs.reset(seed=0)
    finally:
        envs.close(terminate=True)


def test_an_action_of_the_wrong_shape_stops_nobody_silently():
    wide = gym.spaces.Box(-1.0, 1.0, (3, 2), np.float32)
    envs = AsyncVectorEnv(sub_envs(cart_filter))
    try:
        envs.reset(seed=0)
        envs.action_space = wide  # what a policy for another robot would send
        with pytest.raises(ActionError, match=r"expected an action of shape \(1,\), got shape \(2,\)"):
            envs.step(np.zeros((3, 2), np.float32))
    finally:
        envs.close(terminate=True)
