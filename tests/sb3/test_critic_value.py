"""critic_value: what the learner's own critic says, in the env's units."""

import gymnasium as gym
import numpy as np
import pytest
import torch

pytest.importorskip("stable_baselines3")
from stable_baselines3 import DQN, SAC, TD3
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from safe_wrappers.sb3 import critic_value


class Box(gym.Env):
    """Two actions in different units; a flat observation or a dict."""

    action_space = gym.spaces.Box(np.array([-2.0, 0.0], np.float32), np.array([4.0, 1.0], np.float32))

    def __init__(self, as_dict=False):
        self.observation_space = gym.spaces.Box(-5.0, 5.0, (3,), np.float32)
        if as_dict:
            self.observation_space = gym.spaces.Dict({"place": self.observation_space})

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), float(action[0]), False, False, {}


OBSERVATION = np.array([1.0, -2.0, 0.5], np.float32)
ACTIONS = np.array([[-2.0, 0.0], [4.0, 1.0], [1.0, 0.25]], np.float32)
SCALED = torch.tensor([[-1.0, -1.0], [1.0, 1.0], [0.0, -0.5]])


@pytest.mark.parametrize("algorithm", [SAC, TD3])
def test_the_smaller_answer_of_both_networks_to_scaled_actions(algorithm):
    model = algorithm("MlpPolicy", Box(), device="cpu", seed=0)
    with torch.no_grad():
        one, other = model.critic(torch.as_tensor(OBSERVATION).repeat(3, 1), SCALED)
    expected = torch.minimum(one, other)[:, 0].numpy()
    np.testing.assert_allclose(critic_value(model)(OBSERVATION, ACTIONS), expected, atol=1e-6)
    assert np.ptp(expected) > 1e-4


def test_dict_observations_and_scaled_ones():
    model = SAC("MultiInputPolicy", Box(as_dict=True), device="cpu", seed=0)
    with torch.no_grad():
        given = {"place": torch.as_tensor(OBSERVATION).repeat(3, 1)}
        expected = torch.cat(model.critic(given, SCALED), 1).min(1).values.numpy()
    found = critic_value(model)({"place": OBSERVATION}, ACTIONS)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    scaling = VecNormalize(DummyVecEnv([Box]))
    scaling.obs_rms.mean, scaling.obs_rms.var = np.full(3, 1.0), np.full(3, 4.0)
    model = SAC("MlpPolicy", scaling, device="cpu", seed=0)
    with torch.no_grad():
        seen = torch.as_tensor((OBSERVATION - 1.0) / 2.0).repeat(3, 1)
        expected = torch.cat(model.critic(seen, SCALED), 1).min(1).values.numpy()
    np.testing.assert_allclose(critic_value(model)(OBSERVATION, ACTIONS), expected, atol=1e-5)


class Three(Box):
    """Three discrete actions."""

    action_space = gym.spaces.Discrete(3)

    def step(self, action):
        return self.observation_space.sample(), float(action), False, False, {}


EVERY = np.array([[2.0], [0.0], [1.0]])


def test_dqn_is_asked_for_its_values():
    model = DQN("MlpPolicy", Three(), device="cpu", seed=0, buffer_size=100)
    with torch.no_grad():
        expected = model.q_net(torch.as_tensor(OBSERVATION)[None])[0].numpy()[[2, 0, 1]]
    np.testing.assert_allclose(critic_value(model)(OBSERVATION, EVERY), expected, atol=1e-6)
