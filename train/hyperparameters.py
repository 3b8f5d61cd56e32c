"""From the hyperparameters of a config, texts and numbers, to what the constructors of the algorithms take."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from safe_wrappers.errors import ConfigurationError

from .config.algorithms import ALGORITHMS, DISCRETE, OFF_POLICY, ON_POLICY
from .config.names import check_name

if TYPE_CHECKING:
    from stable_baselines3.common.noise import ActionNoise
    from stable_baselines3.common.vec_env import VecEnv

    from .config import ArmConfig

SCHEDULED: Final = ("learning_rate", "clip_range", "clip_range_vf")
"""What may fall in the course of a run."""
HER: Final = "HerReplayBuffer"
_HER_OPTIONS: Final = (
    "n_sampled_goal",
    "goal_selection_strategy",
    "copy_info_dict",
    "handle_timeout_termination",
)
_GOALS: Final = ("future", "final", "episode")
_NOISES: Final = ("normal", "ornstein_uhlenbeck")


@dataclass(frozen=True)
class LinearFall:
    """A schedule in SB3's sense: from `start` at the run's first step to 0 at its last.

    `linear_3e-4` in a config. SB3 calls it with the share of `total_steps` that is still to come, of a continued run
    too. The last rollout may end beyond `total_steps`; a learning rate below 0 would unlearn.
    """

    start: float

    def __call__(self, progress_remaining: float) -> float:
        """The value at this share of the run, 1 at its beginning."""
        return self.start * max(progress_remaining, 0.0)


def linear_start(value: str, where: str) -> float:
    """Reads `linear_3e-4`.

    Raises:
        ConfigurationError: It is something else.
    """
    number = re.fullmatch(r"linear_([0-9.]+(?:[eE][-+]?[0-9]+)?)", value)
    try:
        start = float(number[1]) if number else 0.0
    except ValueError:
        start = 0.0
    if not 0.0 < start < math.inf:
        raise ConfigurationError(
            f"{where}: expected a number, or linear_<number> for one that falls to 0 over total_steps, such as"
            f" linear_3e-4; got {value!r}."
        )
    return start


def check_action_noise(value: Any, where: str) -> None:
    """Refuses what is not `none`, `{normal: 0.1}` or `{ornstein_uhlenbeck: 0.1}`.

    Raises:
        ConfigurationError: It is something else.
    """
    if value is None or value == "none":
        return
    if isinstance(value, Mapping) and len(value) == 1:
        ((kind, size),) = value.items()
        check_name(kind, _NOISES, where)
        if isinstance(size, int | float) and not isinstance(size, bool) and 0.0 < size < math.inf:
            return
    raise ConfigurationError(
        f"{where}: expected none, {{normal: 0.1}} or {{ornstein_uhlenbeck: 0.1}}, a standard deviation above 0 of"
        f" actions scaled to [-1, 1]; got {value!r}."
    )


def check_her(kwargs: Mapping[str, Any], where: str) -> None:
    """Refuses arguments that SB3's HerReplayBuffer does not take.

    Raises:
        ConfigurationError: Unknown names or values of the wrong type.
    """
    for key, value in kwargs.items():
        check_name(key, _HER_OPTIONS, where)
        if key == "goal_selection_strategy":
            check_name(value, _GOALS, f"{where}.{key}")
        elif key == "n_sampled_goal":
            if isinstance(value, bool) or not isinstance(value, int) or value < 0:
                raise ConfigurationError(f"{where}.{key}: expected an integer of at least 0, got {value!r}.")
        elif not isinstance(value, bool):
            raise ConfigurationError(f"{where}.{key}: expected true or false, got {value!r}.")


def constructor_arguments(arm: ArmConfig, envs: VecEnv) -> dict[str, Any]:
    """What the arm's algorithm is made with: its hyperparameters, and the replay buffer that its learner needs."""
    # A copy: SB3 writes into policy_kwargs, and a run folder is known again by its settings.
    settings = deepcopy(arm.hyperparameters)
    for key in SCHEDULED:
        if isinstance(settings.get(key), str):
            settings[key] = LinearFall(linear_start(settings[key], key))
    if isinstance(settings.get("train_freq"), list):  # SB3 wants a tuple, YAML has none
        settings["train_freq"] = tuple(settings["train_freq"])
    if "action_noise" in settings:
        settings["action_noise"] = _action_noise(settings["action_noise"], envs)
    buffer = _replay_buffer(arm, envs)
    if buffer is not None:
        settings["replay_buffer_class"], more = buffer
        settings["replay_buffer_kwargs"] = {**settings.get("replay_buffer_kwargs", {}), **more}
    return settings


def _action_noise(value: Any, envs: VecEnv) -> ActionNoise | None:
    from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise

    if value is None or value == "none":
        return None
    ((kind, size),) = value.items()
    assert envs.action_space.shape is not None
    mean = np.zeros(envs.action_space.shape)
    noise = {"normal": NormalActionNoise, "ornstein_uhlenbeck": OrnsteinUhlenbeckActionNoise}[kind]
    made: ActionNoise = noise(mean, np.full_like(mean, size))
    return made


def _replay_buffer(arm: ArmConfig, envs: VecEnv) -> tuple[type, dict[str, Any]] | None:
    """The class and its mode; None for SB3's choice."""
    from stable_baselines3 import HerReplayBuffer

    from safe_wrappers.sb3 import (
        ExecutedActionDictReplayBuffer,
        ExecutedActionHerReplayBuffer,
        ExecutedActionReplayBuffer,
    )

    mode = {"mode": arm.learner.kind}
    if arm.replays_goals:
        return (HerReplayBuffer, {}) if arm.learner.kind == "naive" else (ExecutedActionHerReplayBuffer, mode)
    if not arm.learner.stores_executed:
        return None
    has_dict = isinstance(envs.observation_space, spaces.Dict)
    return (ExecutedActionDictReplayBuffer if has_dict else ExecutedActionReplayBuffer), mode


def check_task(arm: ArmConfig, env: gym.Env[Any, Any]) -> None:
    """Refuses an arm whose algorithm cannot learn this task, which only the task itself can tell.

    Raises:
        ConfigurationError: Actions of the wrong kind; or, for HER, no goals, or training before an episode ends.
    """
    where = f"arms.{arm.name}"
    for names, kind, wanted in (
        (OFF_POLICY, spaces.Box, "continuous"),
        (DISCRETE, spaces.Discrete, "discrete"),
    ):
        if arm.algorithm in names and not isinstance(env.action_space, kind):
            others = ", ".join(name for name in (*ON_POLICY, *OFF_POLICY, *DISCRETE) if name not in names)
            raise ConfigurationError(
                f"{where}: {arm.algorithm} needs {wanted} actions (a {kind.__name__}), and {arm.env.id} has"
                f" {env.action_space}. Other algorithms: {others}."
            )
    if not arm.replays_goals:
        return
    goals = {"observation", "achieved_goal", "desired_goal"}
    space = env.observation_space
    if not (
        isinstance(space, spaces.Dict) and goals <= set(space) and env.has_wrapper_attr("compute_reward")
    ):
        raise ConfigurationError(
            f"{where}: {HER} needs observations that are a Dict with {', '.join(sorted(goals))}, and a task that has"
            f" compute_reward; {arm.env.id} has {space}. Leave hyperparameters.replay_buffer_class out."
        )
    steps = env.spec.max_episode_steps if env.spec is not None else None
    default = inspect.signature(ALGORITHMS[arm.algorithm]).parameters["learning_starts"].default
    starts = arm.hyperparameters.get("learning_starts", default)
    if steps is not None and starts < steps * arm.n_envs:
        raise ConfigurationError(
            f"{where}: {HER} draws from episodes that have ended. With {arm.n_envs} envs of {steps} steps an episode"
            f" hyperparameters.learning_starts has to be at least {steps * arm.n_envs}; it is {starts}."
        )
