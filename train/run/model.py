"""From an arm's settings to its model."""

from __future__ import annotations

from copy import deepcopy
from typing import Any, Final

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.sb3 import ExecutedActionDictReplayBuffer, ExecutedActionReplayBuffer

from ..config.algorithms import (
    DISCRETE,
    LINEAR,
    OFF_POLICY,
    ON_POLICY,
    SBX,
    SCHEDULED,
    algorithm_class,
    default_of,
)
from ..config.models import ArmConfig

_NOISE: Final = {"normal": NormalActionNoise, "ornstein_uhlenbeck": OrnsteinUhlenbeckActionNoise}


def new_model(arm: ArmConfig, seed: int, envs: VecEnv) -> BaseAlgorithm:
    """The arm's algorithm before its first step, around envs that are scaled as the arm says.

    Raises:
        ConfigurationError: Values that only the algorithm itself knows to be wrong.
    """
    if arm.normalize.observation or arm.normalize.reward:
        envs = VecNormalize(
            envs,
            norm_obs=arm.normalize.observation,
            norm_reward=arm.normalize.reward,
            gamma=arm.hyperparameters.get("gamma", 0.99),
        )
    model: BaseAlgorithm
    try:
        settings = _constructor_arguments(arm, envs)
        model = algorithm_class(arm.algorithm)(env=envs, seed=seed, device=arm.device, **settings)
    except (AssertionError, IndexError, NotImplementedError, TypeError, ValueError) as error:
        raise ConfigurationError(f"arms.{arm.name}: {arm.algorithm} refuses its settings: {error}") from error
    return model


def buffer_size(arm: ArmConfig) -> int:
    """Transitions: SB3's default of a million would be saved with every checkpoint, mostly empty."""
    return int(arm.hyperparameters.get("buffer_size", min(1_000_000, arm.total_steps)))


def _constructor_arguments(arm: ArmConfig, envs: VecEnv) -> dict[str, Any]:
    has_dict = isinstance(envs.observation_space, spaces.Dict)
    policy = "MultiInputPolicy" if has_dict else "MlpPolicy"
    # A copy: SB3 writes into policy_kwargs, and a run folder is known again by its settings.
    settings = {"policy": policy, **deepcopy(arm.hyperparameters)}
    for key in SCHEDULED:
        if isinstance(settings.get(key), str):
            settings[key] = LinearSchedule(float(settings[key].removeprefix(LINEAR)), 0.0, 1.0)
    if isinstance(settings.get("train_freq"), list):  # SB3 wants a tuple, YAML has none
        settings["train_freq"] = tuple(settings["train_freq"])
    if isinstance(settings.get("action_noise"), dict):
        ((kind, size),) = settings["action_noise"].items()
        assert envs.action_space.shape is not None
        mean = np.zeros(envs.action_space.shape)
        settings["action_noise"] = _NOISE[kind](mean, np.full_like(mean, size))
    elif "action_noise" in settings:
        settings["action_noise"] = None
    if arm.algorithm not in ON_POLICY:
        settings["buffer_size"] = buffer_size(arm)
    if arm.learner.stores_executed:
        kind_of = ExecutedActionDictReplayBuffer if has_dict else ExecutedActionReplayBuffer
        settings["replay_buffer_class"] = kind_of
    return settings


def learning_starts(arm: ArmConfig) -> int:
    """Steps of random actions before an off-policy algorithm learns."""
    return int(arm.hyperparameters.get("learning_starts", default_of(arm.algorithm, "learning_starts")))


def whole_rollouts(arm: ArmConfig) -> int:
    """Steps of all envs together that a run makes: `total_steps`, rounded up to whole rollouts."""
    argument = "n_steps" if arm.algorithm in ON_POLICY else "train_freq"
    given = arm.hyperparameters.get(argument, default_of(arm.algorithm, argument))
    count, unit = (given, "step") if isinstance(given, int) else given
    rollout = arm.n_envs * (count if unit == "step" else 1)  # how long episodes are is not known beforehand
    return int(-(-arm.total_steps // rollout) * rollout)


def check_task(arm: ArmConfig, env: gym.Env[Any, Any]) -> None:
    """Refuses an arm whose algorithm does not fit this task, which only the task itself can tell."""
    seen, acts, where = env.observation_space, env.action_space, f"arms.{arm.name}: {arm.algorithm}"
    kind: type = spaces.Box if arm.algorithm in OFF_POLICY else object
    if arm.algorithm in DISCRETE:
        kind = spaces.Discrete
    if not isinstance(acts, kind):
        fitting: tuple[str, ...] = DISCRETE if isinstance(acts, spaces.Discrete) else ()
        others = OFF_POLICY if isinstance(acts, spaces.Box) else fitting
        raise ConfigurationError(
            f"{where} needs actions of a {kind.__name__}, and {arm.env.id} has {acts}."
            f" Other algorithms: {', '.join((*ON_POLICY, *others))}."
        )
    if arm.algorithm.startswith(SBX) and isinstance(seen, spaces.Dict):
        vectors = all(isinstance(part, spaces.Box) and len(part.shape) == 1 for part in seen.values())
        if arm.algorithm in ON_POLICY or not vectors:
            raise ConfigurationError(
                f"{where} observes one array, or off-policy a dict of vectors, and {arm.env.id} has {seen}."
                f" Without {SBX!r} it is the algorithm of a package that can."
            )
