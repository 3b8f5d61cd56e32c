"""The envs of one run: one after the other in its process, or each in a process of its own."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Callable, Iterator
from typing import Any, Final

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from safe_wrappers.errors import RunStateError
from safe_wrappers.wrappers.learner import ActionRepeat

from ..config import ArmConfig
from ..processes.parent import end_with_parent
from .reset_options import ResetOptions
from .stack import make_stack

_ENDED: Final = (
    "The process of an env has ended: killed, out of memory, or with the error that it printed above. The same"
    " command goes on from the last checkpoint. With vec_env: dummy the envs have no processes of their own."
)


def make_vec_env(arm: ArmConfig) -> VecEnv:
    """Makes `arm.n_envs` envs, as `arm.vec_env` says."""
    makes: list[Callable[[], gym.Env[Any, Any]]] = [functools.partial(make_training_env, arm)] * arm.n_envs
    return DummyVecEnv(makes) if arm.vec_env == "dummy" else ProcessVecEnv(makes)


def make_training_env(arm: ArmConfig) -> gym.Env[Any, Any]:
    """One env as the arm trains in it."""
    env = make_stack(arm.env, arm.filter, arm.learner)
    if arm.env.reset_options:
        env = ResetOptions(env, arm.env.reset_options)
    return env if arm.action_repeat == 1 else ActionRepeat(env, arm.action_repeat)


class ProcessVecEnv(SubprocVecEnv):
    """SB3's SubprocVecEnv that gives what DummyVecEnv gives, bit for bit, and leaves no process behind.

    SB3's own gives rewards in float64, where DummyVecEnv has float32, and observations as the env made them,
    whatever the space says: the same run would learn something else in the last digits.

    Args:
        makes: Makes an env each; they must pickle.
        start_method: Of the processes, as in `multiprocessing`.

    Raises:
        RunStateError: An env's process has ended.
    """

    def __init__(self, makes: list[Callable[[], gym.Env[Any, Any]]], start_method: str = "spawn") -> None:
        super().__init__([functools.partial(_in_process, make) for make in makes], start_method)

    def reset(self) -> Any:
        """Resets all envs."""
        with _alive():
            return self._cast(super().reset())

    def step_async(self, actions: NDArray[Any]) -> None:
        """Begins the step of every env."""
        with _alive():
            super().step_async(actions)

    def step_wait(self) -> Any:
        """Waits for the step of every env."""
        with _alive():
            observations, rewards, dones, infos = super().step_wait()
        return self._cast(observations), rewards.astype(np.float32), dones, list(infos)

    def close(self) -> None:
        """Ends the processes, those too that no longer answer."""
        try:
            super().close()
        except (EOFError, OSError):
            for process in self.processes:
                process.terminate()
                process.join()
            self.closed = True

    def _cast(self, observations: Any) -> Any:
        space = self.observation_space
        if isinstance(space, spaces.Dict):
            return {key: part.astype(space[key].dtype, copy=False) for key, part in observations.items()}
        return observations.astype(space.dtype, copy=False)


@contextlib.contextmanager
def _alive() -> Iterator[None]:
    try:
        yield
    except (EOFError, OSError):
        raise RunStateError(_ENDED) from None


def _in_process(make: Callable[[], gym.Env[Any, Any]]) -> gym.Env[Any, Any]:
    end_with_parent()
    # Signals to the whole command (Ctrl-C, `timeout`) are for the run, which decides what becomes of its envs.
    os.setpgrp()
    return make()
