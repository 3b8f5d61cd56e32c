"""Stable-Baselines3 learns policies that emit chunks; RL Zoo finds wrappers by their names, as docs/sb3.md shows."""

import importlib
import re
from pathlib import Path

import gymnasium as gym
import pytest
import torch
import yaml
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor

import safe_wrappers as sw

LIMIT = 8.0
ALGORITHMS = {
    "PPO": (PPO, {"n_steps": 64, "batch_size": 32, "n_epochs": 2}),
    "SAC": (SAC, {"learning_starts": 50, "batch_size": 32, "buffer_size": 1000}),
}


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
    env = Monitor(sw.ChunkHandover(gym.make("Reacher-v5"), size, horizon, delay, rate_limit=LIMIT))
    assert env.action_space.shape == (size, 2)
    algorithm, settings = ALGORITHMS[name]
    model = algorithm("MlpPolicy", env, seed=0, policy_kwargs={"net_arch": [16]}, **settings)
    before, infos = {key: value.clone() for key, value in model.policy.state_dict().items()}, []
    model.learn(200, callback=lambda seen, _: infos.extend(seen["infos"]) or True)
    after = model.policy.state_dict()
    assert any(not torch.equal(before[key], after[key]) for key in before), "it learned something"
    assert all(torch.isfinite(value).all() for value in after.values())
    assert 0.0 < max(info["handover/peak_jerk"] for info in infos) <= LIMIT
    assert size > 1 or sum(info["handover/limited"] for info in infos) > 50
    lengths = {info["episode"]["l"] for info in infos if "episode" in info}
    assert lengths == {-(-50 // horizon)}, "an episode is 50 control steps: 13 chunks of 4"
    action, _ = model.predict(env.reset(seed=1)[0], deterministic=True)
    assert env.action_space.contains(action) and not env.step(action)[4]["handover/refused"]


PAGE = (Path(__file__).parents[2] / "docs" / "sb3.md").read_text(encoding="utf-8")
SHOWN = yaml.safe_load(re.search(r"## RL Zoo.*?```yaml\n(.*?)```", PAGE, re.DOTALL)[1])["SafePointGoal1-v0"]


def named(name):
    """What a dotted name means to the Zoo: the last part is the attribute, the rest the module."""
    module, _, attribute = name.rpartition(".")
    return getattr(importlib.import_module(module), attribute)


def wrapped(env):
    """The Zoo's reading of `env_wrapper`."""
    for each in SHOWN["env_wrapper"]:
        ((name, arguments),) = each.items() if isinstance(each, dict) else [(each, {})]
        env = named(name)(env, **arguments)
    return env


def test_the_page_s_settings_for_the_zoo_make_a_filtered_and_recorded_env_in_which_ppo_learns():
    env = wrapped(gym.make("SafePointGoal1-v0"))
    assert isinstance(env, sw.RecordInterventions) and isinstance(env.env, sw.CBFActionFilter)
    (own,) = sw.protect(gym.make("SafePointGoal1-v0")).constraints
    assert env.env.constraints[0].margin == pytest.approx(own.margin + 0.05)
    envs = make_vec_env("SafePointGoal1-v0", n_envs=2, seed=0, wrapper_class=wrapped)
    model = PPO(SHOWN["policy"], envs, n_steps=16, batch_size=16, n_epochs=1)
    assert model.learn(32, callback=named(SHOWN["callback"])()).num_timesteps == 32
    of_the_zoo = {"env_wrapper", "n_envs", "n_timesteps", "policy", "callback"}
    assert SHOWN.keys() - of_the_zoo <= set(PPO.__init__.__code__.co_varnames)
