"""FilterObservation under SB3: flat observations with VecNormalize, dicts and images with a MultiInputPolicy."""

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import safe_wrappers as sw


def seen(observe=lambda env: env):
    """Reacher in its filter, observed as `observe` makes it, with the filter's features."""
    return sw.FilterObservation(sw.protect(observe(gym.make("Reacher-v5", max_episode_steps=10))))


def as_dict(env):
    space = gym.spaces.Dict({"joints": env.observation_space})
    return gym.wrappers.TransformObservation(env, lambda observation: {"joints": observation}, space)


def as_image(env):
    def drawn(observation):
        return np.full((36, 36, 3), int(50 * abs(observation[0])), np.uint8)

    return gym.wrappers.TransformObservation(env, drawn, gym.spaces.Box(0, 255, (36, 36, 3), np.uint8))


def learned(policy, env):
    model = PPO(policy, env, n_steps=32, batch_size=32, n_epochs=1, device="cpu", seed=0)
    return model.learn(64)


def test_features_are_scaled_with_the_rest_and_stay_so(tmp_path):
    scaled = VecNormalize(DummyVecEnv([seen, seen]))
    learned("MlpPolicy", scaled)
    size = gym.make("Reacher-v5").observation_space.shape[0]
    assert scaled.obs_rms.mean.shape == scaled.observation_space.shape > (size,)
    assert np.ptp(scaled.obs_rms.var[size:]) > 0.0
    scaled.save(tmp_path / "scaling.pkl")
    again = VecNormalize.load(tmp_path / "scaling.pkl", DummyVecEnv([seen]))
    observation = again.venv.reset()
    np.testing.assert_array_equal(again.normalize_obs(observation), scaled.normalize_obs(observation))


@pytest.mark.parametrize(("observe", "key"), [(as_dict, "joints"), (as_image, "observation")])
def test_dicts_and_images_have_the_features_beside_them(observe, key):
    model = learned("MultiInputPolicy", DummyVecEnv([lambda: seen(observe)]))
    assert set(model.observation_space.spaces) == {key, "filter"}
    features = model.env.reset()["filter"]
    assert np.abs(features).max() <= 1.0 and features.any()
