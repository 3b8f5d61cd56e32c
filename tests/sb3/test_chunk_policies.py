"""Stable-Baselines3 policies that emit whole chunks, and single-action ones as chunks of one."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor

import safe_wrappers as sw

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
        now = action.astype(np.float64)
        if self.last is not None:
            self.largest = max(self.largest, float(np.abs(now - self.last).max()))
        self.last = now
        return self.env.step(action)


class Infos(BaseCallback):
    def __init__(self):
        super().__init__()
        self.seen = []

    def _on_step(self):
        self.seen += [dict(info) for info in self.locals["infos"]]
        return True


@pytest.mark.filterwarnings("ignore:a command was held back:UserWarning")
@pytest.mark.parametrize(
    ("name", "size", "horizon", "delay"),
    [
        ("PPO", 10, 4, [0, 2]),
        ("SAC", 10, 4, [0, 2]),
        # What PPO samples is unbounded: SB3 clips it to the box, and the limit holds back the rest.
        ("PPO", 1, 1, [0, 0]),
    ],
)
def test_a_policy_of_chunks_learns_and_predicts(name, size, horizon, delay):
    torch.set_num_threads(1)
    algorithm, settings = ALGORITHMS[name]
    recorder = Recorder(gym.make("Reacher-v5"))
    env = Monitor(sw.ChunkHandover(recorder, size, horizon, delay, rate_limit=LIMIT))
    assert env.action_space.shape == (size, 2)
    model = algorithm("MlpPolicy", env, seed=0, policy_kwargs={"net_arch": [16]}, **settings)
    before = {key: value.clone() for key, value in model.policy.state_dict().items()}
    infos = Infos()
    model.learn(200, callback=infos)
    after = model.policy.state_dict()
    assert any(not torch.equal(before[key], after[key]) for key in before), "it learned something"
    assert all(torch.isfinite(value).all() for value in after.values())
    assert len(infos.seen) >= 200
    assert max(info["handover/peak_jerk"] for info in infos.seen) <= LIMIT
    assert 0.0 < recorder.largest <= LIMIT * recorder.get_wrapper_attr("dt")
    assert size > 1 or sum(info["handover/limited"] for info in infos.seen) > 50
    lengths = {info["episode"]["l"] for info in infos.seen if "episode" in info}
    assert lengths == {-(-50 // horizon)}, "an episode is 50 control steps: 13 chunks of 4"
    action, _ = model.predict(env.reset(seed=1)[0], deterministic=True)
    assert env.action_space.contains(action)
    assert not env.step(action)[4]["handover/refused"]
