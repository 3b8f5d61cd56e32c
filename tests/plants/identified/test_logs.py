"""Logged episodes: what log_steps writes, and what is refused."""

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.identified import checked_episodes


def test_a_log_can_be_replayed():
    env = gym.make("Pendulum-v1", max_episode_steps=30)
    logs = sw.plants.log_steps(env, episodes=3, seed=5)
    assert [(o.shape, a.shape) for o, a in logs] == [((31, 3), (30, 1))] * 3
    other = gym.make("Pendulum-v1", max_episode_steps=30)
    for index, (observations, actions) in enumerate(logs):
        first, _ = other.reset(seed=5 if index == 0 else None)
        np.testing.assert_array_equal(first, observations[0])
        for action, observation in zip(actions, observations[1:], strict=True):
            np.testing.assert_array_equal(other.step(action.astype(np.float32))[0], observation)
    assert not np.array_equal(logs[0].observations, logs[1].observations)


def test_what_a_filter_inside_has_executed_is_logged():
    env = gym.make("InvertedPendulum-v5")
    wall = sw.constraints.Clearance(
        [sw.constraints.Plane([0.9], [-1])], bodies=["cart"], braking=8.0, margin=0.8
    )
    filtered = sw.CBFActionFilter(env, [wall])
    (one,) = sw.plants.log_steps(filtered, lambda x: np.array([3.0], np.float32), episodes=1)
    assert (one.actions < 3.0).any()


GOOD = (np.zeros((4, 2)), np.zeros((3, 1)))


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ([], "list of"),
        ("logs", "list of"),
        (np.zeros((3, 2)), "list of"),
        ([GOOD, 3], "episode 1 is no pair"),
        ([GOOD, (np.zeros((3, 2)), np.zeros((3, 1)))], r"episode 1: expected .* got \(3, 2\) and \(3, 1\)"),
        ([(np.zeros((1, 2)), np.zeros((0, 1)))], "T of at least 1"),
        ([(np.zeros(4), np.zeros((3, 1)))], "episode 0: expected"),
        ([GOOD, (np.zeros((4, 3)), np.zeros((3, 1)))], r"episode 1: expected .* got \(4, 3\) and \(3, 1\)"),
        ([GOOD, (np.zeros((4, 2)), np.zeros((3, 2)))], r"episode 1: expected .* got \(4, 2\) and \(3, 2\)"),
        ([GOOD, (np.array([[0, 0], [0, np.nan], [0, 0], [0, 0]]), GOOD[1])], "of episode 1 must be finite"),
        ([(GOOD[0], np.array([[0.0], [0.0], [np.inf]]))], "actions of episode 0 must be finite"),
        ([({"a": 1}, GOOD[1])], "observations of episode 0 is a number or an array"),
    ],
)  # fmt: skip
def test_other_logs_are_refused(given, says):
    with pytest.raises(ConfigurationError, match=says):
        checked_episodes(given)
