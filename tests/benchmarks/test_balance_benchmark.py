"""The benchmark of the shield that keeps a walker up."""

import gymnasium as gym
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from benchmarks.balance import Actor, Stopping, drive, shielded, trained, walker_h, walker_rests


def make(_):
    return gym.make("Walker2d-v5")


def test_the_actor_is_the_trained_policy(tmp_path):
    actor = trained(tmp_path / "walks", make, 2048, n_epochs=1)
    model = PPO.load(tmp_path / "walks.zip", device="cpu")
    normal = VecNormalize.load(str(tmp_path / "walks.normalize"), DummyVecEnv([lambda: make(0)]))
    env = make(0)
    observation, _ = env.reset(seed=0)
    for _ in range(20):
        expected, _ = model.predict(normal.normalize_obs(observation), deterministic=True)
        np.testing.assert_allclose(actor(observation), expected, atol=1e-5)
        observation, *_ = env.step(env.action_space.sample())
    assert isinstance(trained(tmp_path / "walks", make, 10**9), Actor), "what is there is not trained again"


def test_its_episodes_begin_in_the_middle_of_a_walk():
    env = Stopping(make(0), lambda observation, random: np.full(6, 0.2, dtype=np.float32), seed=0)
    starts = []
    for seed in range(5):
        observation, _ = env.reset(seed=seed)
        assert walker_h(observation) > 0.0, "no episode begins with a fall"
        starts.append(float(np.abs(observation[8:]).max()))
    assert max(starts) > 0.3, "and not all at rest"


def test_its_episodes_last_200_steps_and_pay_for_staying_up():
    endless = gym.make("Walker2d-v5", terminate_when_unhealthy=False)
    env = Stopping(endless, lambda observation, random: np.zeros(6, dtype=np.float32), seed=0)
    env.reset(seed=0)
    ends = []
    for _ in range(201):
        _, reward, fell, late, _ = env.step(np.zeros(6, dtype=np.float32))
        assert not fell and 0.0 < reward <= 1.0
        ends.append(late)
    assert ends.index(True) == 199


def test_a_row_counts_what_the_shield_did():
    def fling(observation, random=None):
        return np.full(6, 1.0, dtype=np.float32)

    def stop(observation):
        return np.zeros(6, dtype=np.float32)

    bare = drive("no filter", lambda env: env, fling, episodes=1, limit=400)
    assert bare.falls == 1 and bare.changed == bare.infeasible == 0
    row = drive("shield", lambda env: shielded(env, stop, 0), fling, episodes=1, limit=125)
    assert row.changed > 0
    assert row.infeasible > 0, "without a controller standing is no rest that lasts, and that is said"


def test_rest_is_upright():
    observation = np.zeros(17)
    assert walker_rests(observation)
    for index, value in ((1, 0.6), (8, 0.4), (16, -0.4)):
        moved = observation.copy()
        moved[index] = value
        assert not walker_rests(moved)
