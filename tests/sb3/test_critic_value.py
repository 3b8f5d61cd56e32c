"""critic_value and log_probability: what the learner's own networks say, in the env's units."""

import gymnasium as gym
import numpy as np
import pytest
import torch

pytest.importorskip("stable_baselines3")
from stable_baselines3 import DQN, PPO, SAC, TD3
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.sb3 import critic_value, log_probability


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


def test_tqc_is_judged_by_the_mean_of_its_quantiles():
    tqc = pytest.importorskip("sb3_contrib").TQC
    model = tqc("MlpPolicy", Box(), device="cpu", seed=0)
    with torch.no_grad():
        quantiles = model.critic(torch.as_tensor(OBSERVATION).repeat(3, 1), SCALED)
    expected = quantiles.mean(2).min(1).values.numpy()
    np.testing.assert_allclose(critic_value(model)(OBSERVATION, ACTIONS), expected, atol=1e-6)


def test_an_escape_takes_the_critic_and_ppo_has_none():
    env = sw.protect(gym.make("SafePointGoal1-v0"))
    model = SAC("MlpPolicy", env, device="cpu", seed=0, buffer_size=100)
    env = sw.StuckEscape(env, after_s=0.02, progress=1e3, escape_s=1.0, value=critic_value(model))
    env.reset(seed=0, options={"layout": {"agent": [0, 0, 0], "hazards": [[0.32, 0.0]], "goal": [1.3, 0.0]}})
    escaping = [env.step(np.array([1.0, 0.0], np.float32))[4]["cbf/escaping"] for _ in range(60)]
    assert any(escaping)
    with pytest.raises(ConfigurationError, match="PPO has none"):
        critic_value(PPO("MlpPolicy", Box(), device="cpu"))


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


def test_a_policys_probabilities():
    model = PPO("MlpPolicy", Three(), device="cpu", seed=0)
    found = log_probability(model)(OBSERVATION, EVERY)
    assert np.exp(found).sum() == pytest.approx(1.0)
    best, _ = model.predict(OBSERVATION, deterministic=True)
    assert EVERY[np.argmax(found), 0] == best
    model = PPO("MlpPolicy", Box(), device="cpu", seed=0)
    mean = (
        model.policy.get_distribution(torch.as_tensor(OBSERVATION)[None]).distribution.mean.detach().numpy()
    )
    nearer = np.concatenate([mean + 0.5, mean, mean + 0.1])
    assert np.argsort(log_probability(model)(OBSERVATION, nearer)).tolist() == [0, 2, 1]
    with pytest.raises(ConfigurationError, match="SAC gives none; critic_value"):
        log_probability(SAC("MlpPolicy", Box(), device="cpu", buffer_size=100))


def test_scaled_observations_of_a_policy():
    scaling = VecNormalize(DummyVecEnv([Three]))
    scaling.obs_rms.mean, scaling.obs_rms.var = np.full(3, 1.0), np.full(3, 4.0)
    model = PPO("MlpPolicy", scaling, device="cpu", seed=0)
    seen = (OBSERVATION - 1.0) / 2.0
    with torch.no_grad():
        expected = model.policy.get_distribution(torch.as_tensor(seen)[None]).distribution.logits[0].numpy()
    np.testing.assert_allclose(log_probability(model)(OBSERVATION, EVERY), expected[[2, 0, 1]], atol=1e-5)
