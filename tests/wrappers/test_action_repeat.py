"""ActionRepeat against a loop over the same env's control steps."""

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers import info as keys


def stack():
    return sw.RecordInterventions(sw.protect(gym.make("SafePointGoal1-v0", max_episode_steps=50)))


def test_rewards_and_costs_are_summed_up_and_the_filter_checks_every_control_step():
    repeated, single = sw.ActionRepeat(stack(), 4), stack()
    layout = {"agent": [0, 0, 0], "hazards": [[0.4, 0.02]], "goal": [1.4, 0]}
    for env in (repeated, single):
        env.reset(seed=0, options={"layout": layout})
    changed = 0
    for decision in range(13):
        action = np.array([1.0, 0.0], dtype=np.float32)
        observation, reward, _, truncated, info = repeated.step(action)
        steps = [single.step(action) for _ in range(4 if decision < 12 else 2)]
        np.testing.assert_array_equal(observation, steps[-1][0])
        assert reward == sum(step[1] for step in steps)
        assert info[keys.CBF_INTERVENED] == any(step[4][keys.CBF_INTERVENED] for step in steps)
        assert info[keys.CBF_CORRECTION] == max(step[4][keys.CBF_CORRECTION] for step in steps)
        changed += info[keys.CBF_INTERVENED]
        assert truncated == (decision == 12)
    assert 0 < changed < 13
    assert info[keys.EPISODE_SUMMARY] == steps[-1][4][keys.EPISODE_SUMMARY]
    assert info[keys.EPISODE_SUMMARY]["length"] == 50


def test_one_control_step_is_the_env_itself():
    once, plain = sw.ActionRepeat(stack(), 1), stack()
    once.reset(seed=2)
    plain.reset(seed=2)
    once.action_space.seed(2)
    for _ in range(20):
        action = once.action_space.sample()
        here, there = once.step(action), plain.step(action)
        np.testing.assert_array_equal(here[0], there[0])
        assert here[1:4] == there[1:4]


@pytest.mark.parametrize("repeat", [0, 2.5, "4"])
def test_a_repeat_that_is_no_count_is_refused(repeat):
    with pytest.raises(sw.SafeWrappersError, match="repeat"):
        sw.ActionRepeat(stack(), repeat)
