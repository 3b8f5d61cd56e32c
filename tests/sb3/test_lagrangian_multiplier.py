"""LagrangianMultiplier: what a learner stores, and how the price on cost moves, against the definition."""

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.sb3 import LagrangianMultiplier

LENGTH = 5


class Toll(gym.Env):
    """Reward 1 and cost 2 for an action above 0, nothing otherwise; episodes of five steps."""

    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    observation_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, judged=True):
        self.judged, self.steps, self.made = judged, 0, []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.steps += 1
        taken = float(action[0] > 0.0)
        self.made.append((taken, 2.0 * taken))
        info = {"cost": 2.0 * taken} if self.judged else {}
        return np.zeros(1, np.float32), taken, False, self.steps == LENGTH, info


class NoNumber(Toll):
    """Its cost is NaN."""

    def step(self, action):
        observation, reward, terminated, truncated, _ = super().step(action)
        return observation, reward, terminated, truncated, {"cost": np.nan}


class Goals(Toll):
    """With goals, as hindsight replay needs them."""

    observation_space = gym.spaces.Dict(
        {key: Toll.observation_space for key in ("observation", "achieved_goal", "desired_goal")}
    )

    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed)
        return dict.fromkeys(self.observation_space, observation), info

    def compute_reward(self, achieved, desired, info):
        return np.zeros(len(achieved))


def expected(made, limit, rate, multiplier=0.0):
    """What is stored of each step, and the multiplier after the last one, from the definition."""
    stored, total = [], 0.0
    for step, (reward, cost) in enumerate(made, start=1):
        stored.append((reward - multiplier * cost) / (1.0 + multiplier))
        total += cost
        if step % LENGTH == 0:
            multiplier, total = max(0.0, multiplier + rate * (total - limit)), 0.0
    return stored, multiplier


class Stored(BaseCallback):
    """Of an on-policy learner: the rewards of all rollouts, before they are thrown away."""

    def __init__(self):
        super().__init__()
        self.rewards = []

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        self.rewards += self.model.rollout_buffer.rewards[:, 0].tolist()


def ppo(env, **more):
    return PPO(
        "MlpPolicy", env, n_steps=20, batch_size=20, n_epochs=1, gamma=0.0, device="cpu", seed=0, **more
    )


def test_ppo_stores_the_reward_less_the_price_of_cost_and_the_price_follows_every_episode():
    task, stored = Toll(), Stored()
    model = ppo(Monitor(task))
    model.lagrangian_multiplier = 0.1
    model.learn(60, callback=[LagrangianMultiplier(cost_limit=3.0, rate=0.05), stored])
    rewards, multiplier = expected(task.made, 3.0, 0.05, 0.1)
    assert any(cost for _, cost in task.made) and len(stored.rewards) == 60
    np.testing.assert_allclose(stored.rewards, rewards, atol=1e-6)
    assert model.lagrangian_multiplier == pytest.approx(multiplier)
    # Monitor has the task's own returns.
    returns = [sum(reward for reward, _ in task.made[i : i + LENGTH]) for i in range(0, 60, LENGTH)]
    assert [episode["r"] for episode in model.ep_info_buffer] == returns


def test_sac_replays_what_was_stored_at_the_multiplier_of_that_time():
    task = Toll()
    model = SAC("MlpPolicy", task, learning_starts=30, buffer_size=30, device="cpu", seed=0)
    model.learn(30, callback=LagrangianMultiplier(cost_limit=0.0, rate=0.05))
    rewards, multiplier = expected(task.made, 0.0, 0.05)
    np.testing.assert_allclose(model.replay_buffer.rewards[:30, 0], rewards, atol=1e-6)
    assert multiplier > 0.0
    assert model.lagrangian_multiplier == pytest.approx(multiplier)


def test_the_multiplier_goes_on_from_a_saved_model(tmp_path):
    model = ppo(Toll())
    model.learn(20, callback=LagrangianMultiplier(cost_limit=0.0, rate=0.05))
    model.save(tmp_path / "model")
    task = Toll()
    again = PPO.load(tmp_path / "model", env=task, device="cpu")
    assert again.lagrangian_multiplier == model.lagrangian_multiplier > 0.0
    again.learn(20, callback=LagrangianMultiplier(cost_limit=0.0, rate=0.05), reset_num_timesteps=False)
    begun = 4 * LENGTH  # the env is reset in between
    assert again.lagrangian_multiplier == pytest.approx(
        expected(task.made[:begun], 0.0, 0.05, model.lagrangian_multiplier)[1]
    )


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"cost_limit": -1.0}, "cost_limit"),
        ({"cost_limit": 1.0, "rate": 0.0}, "rate"),
    ],
)
def test_numbers_that_make_no_price_are_refused(wrong, named):
    with pytest.raises(ConfigurationError, match=named):
        LagrangianMultiplier(**wrong)


def test_an_env_without_cost_and_rewards_that_are_stored_elsewhere_are_refused():
    with pytest.raises(ConfigurationError, match="CostFunction"):
        ppo(Toll(judged=False)).learn(20, callback=LagrangianMultiplier(1.0))
    with pytest.raises(ConfigurationError, match="must be finite"):
        ppo(NoNumber()).learn(20, callback=LagrangianMultiplier(1.0))
    goals = SAC(
        "MultiInputPolicy", Goals(), replay_buffer_class=HerReplayBuffer, buffer_size=100, device="cpu"
    )
    with pytest.raises(ConfigurationError, match="hindsight"):
        goals.learn(20, callback=LagrangianMultiplier(1.0))
    scaled = VecNormalize(DummyVecEnv([Toll]))
    with pytest.raises(ConfigurationError, match="VecNormalize"):
        SAC("MlpPolicy", scaled, device="cpu").learn(20, callback=LagrangianMultiplier(1.0))
