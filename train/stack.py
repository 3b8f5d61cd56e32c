"""The whole stack of one env, from the task to SB3's Monitor, and in training the learner's penalty around it."""

from __future__ import annotations

import importlib
from typing import Any

import gymnasium as gym
from stable_baselines3.common.monitor import Monitor

import safe_wrappers
from safe_wrappers import interventions as keys
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.wrappers.adaption_penalty import AdaptionPenalty
from safe_wrappers.wrappers.record_interventions import RecordInterventions

from .config import NAIVE, EnvConfig, FilterConfig, LearnerConfig
from .names import check_name


def make_stack(
    env: EnvConfig, action_filter: FilterConfig, learner: LearnerConfig = NAIVE
) -> gym.Env[Any, Any]:
    """Makes the task, its filter if there is one, the recorder and Monitor; AdaptionPenalty outermost if asked for.

    The recorder and Monitor see the task's own reward, whatever the learner sees.

    Args:
        env: The task.
        action_filter: The filter around it.
        learner: In training the arm's; in evaluation left out, so that no return ever holds a penalty.

    Raises:
        ConfigurationError: The task or the filter refuses its settings.
    """
    try:
        task: gym.Env[Any, Any] = gym.make(env.id, **env.kwargs)
    except (TypeError, gym.error.Error, ImportError) as error:
        raise ConfigurationError(f"env: {env.id} with kwargs {env.kwargs} cannot be made: {error}") from error
    if action_filter.kind == "protect":
        task = safe_wrappers.protect(task, **action_filter.kwargs)
    elif action_filter.kind == "factory":
        factory = _factory(action_filter)
        try:
            task = factory(task, **action_filter.kwargs)
        except TypeError as error:
            raise ConfigurationError(
                f"filter: {action_filter.factory} refuses its kwargs: {error}"
            ) from error
    monitored = Monitor(RecordInterventions(task), info_keywords=keys.RUNNING)
    if not learner.penalised:
        return monitored
    return AdaptionPenalty(monitored, penalty=learner.penalty, per_correction=learner.per_correction)


def _factory(action_filter: FilterConfig) -> Any:
    module_name, _, function = action_filter.factory.partition(":")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise ConfigurationError(f"filter.factory: cannot import {module_name!r}: {error}") from None
    check_name(function, [name for name in dir(module) if not name.startswith("_")], f"{module_name}")
    return getattr(module, function)
