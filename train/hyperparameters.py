"""From the hyperparameters of a config, texts and numbers, to what the constructors of the algorithms take.

Checkpoints name `LinearFall` by this module's path.
"""

from __future__ import annotations

import inspect
from copy import deepcopy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from safe_wrappers.errors import ConfigurationError

from .config.algorithm_settings import HER, LINEAR, SCHEDULED
from .config.algorithms import ALGORITHMS, DISCRETE, MASKED, OFF_POLICY, ON_POLICY, RECURRENT

if TYPE_CHECKING:
    from stable_baselines3.common.noise import ActionNoise
    from stable_baselines3.common.vec_env import VecEnv

    from .config import ArmConfig


_ANY_ACTIONS: Final = tuple(name for name in ON_POLICY if name not in MASKED)


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


def constructor_arguments(arm: ArmConfig, envs: VecEnv) -> dict[str, Any]:
    """What the arm's algorithm is made with: hyperparameters, a policy for its observations, its replay buffer."""
    has_dict = isinstance(envs.observation_space, spaces.Dict)
    policy = f"{'MultiInput' if has_dict else 'Mlp'}{'Lstm' if arm.algorithm in RECURRENT else ''}Policy"
    # A copy: SB3 writes into policy_kwargs, and a run folder is known again by its settings.
    settings = {"policy": policy, **deepcopy(arm.hyperparameters)}
    for key in SCHEDULED:
        if isinstance(settings.get(key), str):
            settings[key] = LinearFall(float(settings[key].removeprefix(LINEAR)))
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
        own = arm.learner.stores_executed or arm.learner.penalised
        return (ExecutedActionHerReplayBuffer, mode) if own else (HerReplayBuffer, {})
    if not arm.learner.stores_executed:
        return None
    has_dict = isinstance(envs.observation_space, spaces.Dict)
    return (ExecutedActionDictReplayBuffer if has_dict else ExecutedActionReplayBuffer), mode


def learning_starts(arm: ArmConfig) -> int:
    """Steps of random actions before an off-policy algorithm learns."""
    default = inspect.signature(ALGORITHMS[arm.algorithm]).parameters["learning_starts"].default
    return int(arm.hyperparameters.get("learning_starts", default))


def whole_rollouts(arm: ArmConfig) -> int:
    """Steps of all envs together that a run makes: `total_steps`, rounded up to whole rollouts."""
    argument = "n_steps" if arm.algorithm in ON_POLICY else "train_freq"
    default = inspect.signature(ALGORITHMS[arm.algorithm]).parameters[argument].default
    given = arm.hyperparameters.get(argument, default)
    count, unit = (given, "step") if isinstance(given, int) else given
    rollout = arm.n_envs * (count if unit == "step" else 1)  # how long episodes are is not known beforehand
    return -(-arm.total_steps // rollout) * rollout


def check_task(arm: ArmConfig, env: gym.Env[Any, Any]) -> None:
    """Refuses an arm whose algorithm cannot learn this task, which only the task itself can tell.

    Raises:
        ConfigurationError: Actions of the wrong kind; or, for HER, no goals, or training before an episode ends.
    """
    where = f"arms.{arm.name}"
    for names, kinds, wanted, instead in (
        (OFF_POLICY, (spaces.Box,), "continuous", (*ON_POLICY, *DISCRETE)),
        (DISCRETE, (spaces.Discrete,), "discrete", (*_ANY_ACTIONS, *OFF_POLICY)),
        (MASKED, (spaces.Discrete, spaces.MultiDiscrete), "discrete", (*_ANY_ACTIONS, *OFF_POLICY)),
    ):
        if arm.algorithm in names and not isinstance(env.action_space, kinds):
            boxes = " or ".join(kind.__name__ for kind in kinds)
            raise ConfigurationError(
                f"{where}: {arm.algorithm} needs {wanted} actions (a {boxes}), and {arm.env.id} has"
                f" {env.action_space}. Other algorithms: {', '.join(instead)}."
            )
    if arm.algorithm in MASKED and not env.has_wrapper_attr("action_masks"):
        raise ConfigurationError(
            f"{where}: {arm.algorithm} asks the env at every step which actions are allowed, and neither {arm.env.id}"
            " nor the arm's filter has action_masks. Give the arm a filter (an ActionShield has them), or use PPO."
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
    starts = learning_starts(arm)
    if steps is not None and starts < steps * arm.n_envs:
        raise ConfigurationError(
            f"{where}: {HER} draws from episodes that have ended. With {arm.n_envs} envs of {steps} steps an episode"
            f" hyperparameters.learning_starts has to be at least {steps * arm.n_envs}; it is {starts}."
        )
