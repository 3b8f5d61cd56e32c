"""The envs of one run: one after the other in its process, or each in a process of its own."""

from __future__ import annotations

import functools
import signal
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from safe_wrappers import ActionRepeat

from ..config import ArmConfig
from .stack import make_stack


def make_vec_env(arm: ArmConfig) -> VecEnv:
    """Makes `arm.n_envs` envs, as `arm.vec_env` says."""
    if arm.vec_env == "dummy":
        return DummyVecEnv([functools.partial(make_training_env, arm)] * arm.n_envs)
    return SubprocVecEnv([functools.partial(_in_process, arm)] * arm.n_envs, "spawn")


def make_training_env(arm: ArmConfig) -> gym.Env[Any, Any]:
    """One env as the arm trains in it."""
    env = make_stack(arm.env, arm.filter, arm.learner)
    if arm.env.reset_options:
        env = ResetOptions(env, arm.env.reset_options)
    return env if arm.action_repeat == 1 else ActionRepeat(env, arm.action_repeat)


class ResetOptions(gym.Wrapper[Any, Any, Any, Any]):
    """Gives options to every reset; a reset's own come on top."""

    def __init__(self, env: gym.Env[Any, Any], options: Mapping[str, Any]) -> None:
        super().__init__(env)
        self._options = options

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Resets the env."""
        return self.env.reset(seed=seed, options={**self._options, **(options or {})})


def _in_process(arm: ArmConfig) -> gym.Env[Any, Any]:
    # Signals to the whole command (Ctrl-C, `timeout`) are for the run, which decides what becomes of its envs.
    for which in (signal.SIGINT, signal.SIGHUP):
        signal.signal(which, signal.SIG_IGN)
    return make_training_env(arm)
