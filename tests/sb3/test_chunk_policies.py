"""Stable-Baselines3 policies that emit whole chunks, and single-action ones as chunks of one."""

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
torch = pytest.importorskip("torch")
from stable_baselines3 import PPO, SAC  # noqa: E402
from stable_baselines3.common.callbacks import BaseCallback  # noqa: E402
from stable_baselines3.common.monitor import Monitor  # noqa: E402

import safe_wrappers as sw  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore:a command was held back:UserWarning")
LIMIT = 8.0
ALGORITHMS = {
    "PPO": (PPO, {"n_steps": 64, "batch_size": 32, "n_epochs": 2}),
    "SAC": (SAC, {"learning_starts": 50, "batch_size": 32, "buffer_size": 1000}),
}


class Recorder(gym.Wrapper):
    """The largest step between two commands of an episode, ever."""

    largest = 0.0

    def reset(self, **how):
        self.last = None
        return self.env.reset(**how)

    def step(self, action):
        assert self.action_space.contains(action)
        if self.last is not None:
            self.largest = max(self.largest, float(np.abs(action.astype(np.float64) - self.last).max()))
        self.last = action.astype(np.float64)
        return self.env.step(action)


def chunked(size=10, horizon=4, delay=(0, 2)):
    env = Recorder(gym.make("Reacher-v5"))
    return Monitor(sw.ChunkHandover(env, size, horizon, list(delay), rate_limit=LIMIT))


class Infos(BaseCallback):
    def __init__(self):
        super().__init__()
        self.seen = []

    def _on_step(self):
        self.seen += [dict(info) for info in self.locals["infos"]]
        return True


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_policy_of_whole_chunks_learns_and_predicts(name):
    torch.set_num_threads(1)
    algorithm, settings = ALGORITHMS[name]
    env = chunked()
    assert env.action_space.shape == (10, 2)
    model = algorithm("MlpPolicy", env, seed=0, policy_kwargs={"net_arch": [16]}, **settings)
    before = {k: v.clone() for k, v in model.policy.state_dict().items()}
    infos = Infos()
    model.learn(200, callback=infos)
    after = model.policy.state_dict()
    assert any(not torch.equal(before[k], after[k]) for k in before), "it learned something"
    assert all(torch.isfinite(v).all() for v in after.values())
    assert len(infos.seen) >= 200
    assert max(i["handover/peak_jerk"] for i in infos.seen) <= LIMIT
    recorder = env.env.env
    assert 0.0 < recorder.largest <= LIMIT * recorder.get_wrapper_attr("dt")
    observation = env.reset(seed=1)[0]
    action, _ = model.predict(observation, deterministic=True)
    assert action.shape == (10, 2) and env.action_space.contains(action)
    assert not env.step(action)[4]["handover/refused"]
    episodes = [i["episode"] for i in infos.seen if "episode" in i]
    assert {e["l"] for e in episodes} == {13}, "50 control steps are 13 chunks of 4"


def test_a_single_action_policy_as_chunks_of_one():
    """What PPO samples is unbounded: SB3 clips it to the box, and the limit holds back the rest."""
    torch.set_num_threads(1)
    env = chunked(1, 1, (0, 0))
    model = PPO("MlpPolicy", env, seed=0, n_steps=64, batch_size=32, n_epochs=1)
    infos = Infos()
    model.learn(128, callback=infos)
    assert sum(i["handover/limited"] for i in infos.seen) > 50
    assert env.env.env.largest <= LIMIT * env.unwrapped.dt
    assert model.predict(env.reset(seed=0)[0])[0].shape == (1, 2)
