"""RL Zoo finds `protect` and the other wrappers by their names, as docs/sb3.md shows it."""

import importlib
import re
from pathlib import Path

import gymnasium as gym
import pytest
import yaml
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

import safe_wrappers as sw

PAGE = (Path(__file__).parents[2] / "docs" / "sb3.md").read_text(encoding="utf-8")
SHOWN = yaml.safe_load(re.search(r"## RL Zoo.*?```yaml\n(.*?)```", PAGE, re.DOTALL)[1])["SafePointGoal1-v0"]


def named(name):
    """What a dotted name means to the Zoo: the last part is the attribute, the rest the module."""
    module, _, attribute = name.rpartition(".")
    return getattr(importlib.import_module(module), attribute)


def read_by_itself(settings):
    """The Zoo's reading of `env_wrapper`; its own, where it is installed, reads the same."""

    def wrap(env):
        for each in settings["env_wrapper"]:
            ((name, arguments),) = each.items() if isinstance(each, dict) else [(each, {})]
            env = named(name)(env, **arguments)
        return env

    return wrap


def read_by_the_zoo(settings):
    return pytest.importorskip("rl_zoo3.utils").get_wrapper_class(settings)


@pytest.mark.parametrize("read", [read_by_itself, read_by_the_zoo])
def test_the_page_s_settings_make_a_filtered_and_recorded_env(read):
    env = read(SHOWN)(gym.make("SafePointGoal1-v0"))
    assert isinstance(env, sw.RecordInterventions) and isinstance(env.env, sw.CBFActionFilter)
    (own,) = sw.protect(gym.make("SafePointGoal1-v0")).constraints
    assert env.env.constraints[0].margin == pytest.approx(own.margin + 0.05)


def test_ppo_learns_with_the_page_s_settings_as_the_zoo_makes_it():
    seen = []

    class Seen(named(SHOWN["callback"])):
        def _on_step(self):
            seen.extend(self.locals["infos"])
            return super()._on_step()

    envs = make_vec_env("SafePointGoal1-v0", n_envs=2, seed=0, wrapper_class=read_by_itself(SHOWN))
    PPO(SHOWN["policy"], envs, n_steps=16, batch_size=16, n_epochs=1).learn(32, callback=Seen())
    assert len(seen) == 32 and all("cbf/margin" in info for info in seen)
    of_the_zoo = {"env_wrapper", "n_envs", "n_timesteps", "policy", "callback"}
    assert SHOWN.keys() - of_the_zoo <= set(PPO.__init__.__code__.co_varnames)
