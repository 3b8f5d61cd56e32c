"""Envs whose rewards are vectors, as mo-gymnasium's: summed up per component, or refused with what helps."""

import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError

sys.path.append(str(Path(__file__).parents[1] / "plants" / "simulator"))
from simulated_worlds import Cart, Grid

WEIGHT = np.array([1.0, 0.5])


class Two(gym.Wrapper):
    """Two objectives, declared as mo-gymnasium's envs declare them: the task's reward, and time."""

    def __init__(self, env, declared=True):
        super().__init__(env)
        if declared:
            env.reward_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, np.array([reward, -1.0], np.float32), terminated, truncated, info


def stopping(make):
    """A filter that changes actions."""
    slow = sw.constraints.PredictiveShield(lambda x: 0.25 - abs(x[1]), 4, backup=lambda x: [-np.sign(x[1])])
    return sw.CBFActionFilter(make, [slow], plant=sw.SimulatorPlant(check_steps=50))


def driven(env, steps=6):
    """Rewards and the last info."""
    env.reset(seed=0)
    answers = [env.step(env.action_space.high) for _ in range(steps)]
    return np.array([answer[1] for answer in answers]), answers[-1][4]


def test_a_recorder_sums_up_each_component():
    env = sw.RecordInterventions(stopping(gym.wrappers.TimeLimit(Two(Cart()), 6)))
    rewards, info = driven(env)
    assert rewards.shape == (6, 2)
    np.testing.assert_allclose(info["interventions"]["return"], rewards.sum(axis=0))
    assert info["interventions"]["intervention_rate"] > 0.0
    scalar = sw.RecordInterventions(gym.wrappers.TimeLimit(Cart(), 6))
    assert type(driven(scalar)[1]["interventions"]["return"]) is float


def test_wrappers_that_add_up_rewards_add_up_each_component():
    repeated = sw.ActionRepeat(Two(Cart()), 3)
    chunked = sw.ChunkHandover(Two(Cart()), 3, 3, fallback="zero", rate_limit=100.0)
    for env, action in ((repeated, np.ones(1)), (chunked, np.ones((3, 1)))):
        env.reset(seed=0)
        total = env.step(action)[1]
        assert total.shape == (2,) and total[1] == -3.0
        assert -1.0 < total[0] < 0.0


def test_a_shield_simulates_what_has_several_objectives():
    env = sw.ActionShield(Two(Grid()), [sw.constraints.PredictiveShield("cost", 2, backup=[0, 1, 2, 3])])
    env.reset(seed=0)
    assert env.step(1)[1].shape == (2,)

    class Forgetful(Two):
        count = [0]  # noqa: RUF012 - shared by the copies, which is what the check finds

        def step(self, action):
            answer = super().step(action)
            self.count[0] += 1
            answer[1][1] = self.count[0]
            return answer

    with pytest.raises(ConfigurationError, match=r"its reward\[1\] is .* instead of"):
        sw.SimulatorPlant(check_steps=20).bind(Forgetful(Cart()))


WEIGHING = {
    "AdaptionPenalty": lambda env: sw.AdaptionPenalty(env, penalty=0.5),
    "StuckEscape": lambda env: sw.StuckEscape(env, after_s=0.2),
    "a recorder's file": lambda env: sw.RecordInterventions(env, "episodes.csv"),
}


@pytest.mark.parametrize("name", WEIGHING)
def test_what_needs_one_number_says_at_construction_what_makes_it(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigurationError, match=r"one number.*LinearReward.*TransformReward"):
        WEIGHING[name](stopping(Two(Cart())))
    undeclared = WEIGHING[name](stopping(Two(Cart(), declared=False)))
    undeclared.reset(seed=0)
    with pytest.raises(ConfigurationError, match=r"one number.*LinearReward.*TransformReward"):
        undeclared.step(np.ones(1))

    weighed = gym.wrappers.TransformReward(Two(Cart()), lambda r: float(WEIGHT @ r))
    rewards, _ = driven(WEIGHING[name](stopping(weighed)))
    assert rewards.shape == (6,)

    class LinearReward(Two):  # as of mo_gymnasium, whose env keeps its reward_space
        def step(self, action):
            observation, reward, *rest = super().step(action)
            return (observation, float(WEIGHT @ reward), *rest)

    np.testing.assert_allclose(driven(WEIGHING[name](stopping(LinearReward(Cart()))))[0], rewards, rtol=1e-6)
