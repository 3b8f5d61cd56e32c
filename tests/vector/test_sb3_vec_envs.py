"""SB3's Dummy and Subproc vector envs are the single envs, bit for bit, infos and all."""

import contextlib
import functools

import gymnasium as gym
import numpy as np
import pytest
from sb3_loops import assert_same, unroll
from single_loops import by_hand, script
from vector_worlds import AtHazard, cart

import safe_wrappers as sw

pytest.importorskip("stable_baselines3")
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from safe_wrappers.train.config import EnvConfig, FilterConfig
from safe_wrappers.train.run.stack import make_stack

pytestmark = pytest.mark.filterwarnings("ignore:the policy's action:UserWarning")
KINDS = {"dummy": DummyVecEnv, "subproc": functools.partial(SubprocVecEnv, start_method="fork")}
every_kind = pytest.mark.parametrize("kind", KINDS)


def monitored_cart(index):
    return Monitor(cart(index))


def stack(env_id, name, steps, index):
    """The training's own stack, Monitor outermost."""
    env = EnvConfig(env_id, {"max_episode_steps": steps + 2 * index})
    return make_stack(env, FilterConfig(factory=f"vector_worlds:{name}"))


def plain_stack(index):
    return make_stack(EnvConfig("SafePointGoal1-v0", {"max_episode_steps": 5}), FilterConfig(protect={}))


TASKS = {
    "cart": monitored_cart,
    "point_goal": functools.partial(stack, "SafePointGoal1-v0", "point_goal_filter", 7),
    "reacher": functools.partial(stack, "Reacher-v5", "reacher_filter", 7),
    "pendulum": functools.partial(stack, "InvertedPendulum-v5", "pendulum_filter", 9),
}


@every_kind
@pytest.mark.parametrize("task", TASKS)
def test_a_vec_env_is_its_single_envs(task, kind):
    make = TASKS[task]
    with contextlib.closing(KINDS[kind]([functools.partial(make, i) for i in range(3)])) as envs:
        actions = script(envs.action_space, drive=0.9 if task == "point_goal" else None)
        episodes = unroll(envs, actions, seed=5, steps=26)
        calls = envs.get_attr("filter_calls")
    for i, got in enumerate(episodes):
        wanted = by_hand(make, actions, i, seed=5 + i, steps=26)
        assert assert_same(got, wanted, kind, f"sub-env {i}, ") >= 2
        steps = [step for episode in got for step in episode.steps]
        assert any(s.info["cbf/intervened"] and not s.info["cbf/nonfinite"] for s in steps)
        assert any(s.info["cbf/nonfinite"] for s in steps)
        assert calls[i] == len(steps)
        for episode in got[:-1]:
            # The recorder's summary and Monitor's agree, and Monitor has its keywords from the terminal step.
            info = episode.steps[-1].info
            assert info["episode"]["l"] == info["interventions"]["length"] == len(episode.steps)
            assert info["episode"]["r"] == round(info["interventions"]["return"], 6)


@every_kind
def test_methods_and_attributes_by_sub_env(kind):
    with contextlib.closing(KINDS[kind]([functools.partial(plain_stack, i) for i in range(2)])) as envs:
        envs.seed(0)
        envs.reset()
        for _ in range(6):
            envs.step(np.stack([envs.action_space.sample() for _ in range(2)]))
        assert envs.get_attr("filter_calls") == [6, 6]
        assert all(0.0 < seconds < 3.0 for seconds in envs.get_attr("filter_seconds"))
        for constraints in envs.get_attr("constraints"):
            assert [(type(c).__name__, c.promise) for c in constraints] == [
                ("HeadingDriveClearance", "proved")
            ]
        assert envs.env_method("has_wrapper_attr", "filter_seconds", indices=1) == [True]
        assert envs.env_method("get_episode_lengths") == [[5], [5]]
        assert envs.env_is_wrapped(sw.CBFActionFilter) == [True, True]
        assert envs.env_is_wrapped(sw.RecordInterventions) == [True, True]
        assert envs.env_is_wrapped(Monitor) == [True, True]


SHARED = [
    sw.constraints.HeadingDriveClearance(
        [sw.constraints.Discs("hazard_positions", radius=0.2)], margin=0.004, detour=True
    )
]
"""One constraint for all: the filter's business is to take a copy."""


def sharing(index):
    env = sw.CBFActionFilter(AtHazard(gym.make("SafePointGoal1-v0", max_episode_steps=8 + index)), SHARED)
    return Monitor(sw.RecordInterventions(env))


def test_two_envs_in_one_process_share_nothing_but_what_they_were_given():
    before = repr(SHARED), set(vars(SHARED[0]))
    envs = DummyVecEnv([functools.partial(sharing, i) for i in range(2)])
    actions = script(envs.action_space, drive=0.9)
    episodes = unroll(envs, actions, seed=8, steps=30)
    first, second = envs.get_attr("constraints")
    assert first[0] is not second[0] and first[0] is not SHARED[0]
    assert envs.get_attr("plant")[0] is not envs.get_attr("plant")[1]
    # Step by step in turn they are what each is alone.
    for i, got in enumerate(episodes):
        alone = by_hand(sharing, actions, i, seed=8 + i, steps=30)
        assert assert_same(got, alone, "dummy", f"sub-env {i}, ") >= 2
        assert any(s.info["cbf/intervened"] for e in got for s in e.steps)
    assert (repr(SHARED), set(vars(SHARED[0]))) == before
