"""The whole stack of one env, from the task to SB3's Monitor, with the learner's map inside or its penalty around."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
from stable_baselines3.common.monitor import Monitor

import safe_wrappers
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants import MujocoPlant
from safe_wrappers.wrappers.cbf_action_filter import filter_inside
from safe_wrappers.wrappers.cost_function import CostFunction
from safe_wrappers.wrappers.faults import FAULTS
from safe_wrappers.wrappers.learner import AdaptionPenalty, FilterObservation
from safe_wrappers.wrappers.lease_expiry import LeaseExpiry
from safe_wrappers.wrappers.occlusion_penalty import OcclusionPenalty
from safe_wrappers.wrappers.record_interventions import RecordInterventions
from safe_wrappers.wrappers.replaced_actions import SafeActionMap, StuckEscape

from ..config import NAIVE, EnvConfig, FilterConfig, LearnerConfig
from ..config.env_ids import make_env
from ..config.names import check_name
from ..filter_module import refuse_without_recipe
from ..local_imports import own_folders
from .judge import ConstraintJudge


def make_stack(
    env: EnvConfig,
    action_filter: FilterConfig,
    learner: LearnerConfig = NAIVE,
    render_mode: str | None = None,
) -> gym.Env[Any, Any]:
    """Makes the task with all its layers, from the judge to SB3's Monitor.

    The recorder counts the task's own reward, whatever the learner sees. Monitor does too, but for OcclusionPenalty,
    which is inside of it.

    Args:
        env: The task.
        action_filter: The filter around it.
        learner: In training the arm's; in evaluation its `in_evaluation`, so that no return ever holds a penalty.
            Without a filter there is nothing to map onto, and no map.
        render_mode: As `gymnasium.make` takes it; None: as the config has it.

    Raises:
        ConfigurationError: The task or the filter refuses its settings.
    """
    kwargs = env.kwargs if render_mode is None else {**env.kwargs, "render_mode": render_mode}
    task = make_env(env.id, kwargs)
    if env.cost is not None:
        task = CostFunction(task, _function(env.cost, "env.cost"))
    if env.judge is not None:
        task = ConstraintJudge(task, _filtered(task, env.judge))
    if env.occlusion is not None:
        try:
            task = OcclusionPenalty(task, **env.occlusion)
        except TypeError as error:
            raise ConfigurationError(f"env.occlusion: {error}") from None
    observed = None if env.observation is None else _filtered(task, env.observation)
    task = _filtered(task, action_filter)
    if action_filter.lease is not None:
        task = _leased(task, action_filter.lease)
    if learner.maps and action_filter.kind != "none":
        task = SafeActionMap(task)
    if observed is not None:
        task = _with_features(task, observed)
    if action_filter.escape is not None:
        task = StuckEscape(task, **action_filter.escape)
    recorded: gym.Env[Any, Any] = RecordInterventions(task)
    for name, arguments in env.faults.items():
        try:
            recorded = FAULTS[name](recorded, **arguments)
        except TypeError as error:
            raise ConfigurationError(f"env.faults.{name}: {error}") from None
    monitored = Monitor(recorded)
    if not learner.penalised:
        return monitored
    return AdaptionPenalty(monitored, **learner.penalties)


def _filtered(task: gym.Env[Any, Any], action_filter: FilterConfig) -> gym.Env[Any, Any]:
    """The task in its filter; as it is if there is none."""
    if action_filter.protect is not None:
        refuse_without_recipe(task)
        return safe_wrappers.protect(task, **action_filter.protect)
    if action_filter.factory is not None:
        factory = _function(action_filter.factory, "filter.factory")
        try:
            filtered: gym.Env[Any, Any] = factory(task, **action_filter.kwargs)
        except TypeError as error:
            raise ConfigurationError(
                f"filter: {action_filter.factory} refuses its kwargs: {error}"
            ) from error
        return filtered
    return task


def _with_features(task: gym.Env[Any, Any], observed: gym.Env[Any, Any]) -> FilterObservation:
    """The task with what its filter decides by; without one, what a filter around it, which is not stepped, would."""
    if filter_inside(task) is not None:
        return FilterObservation(task)
    observer = filter_inside(observed)
    if observer is None:
        raise ConfigurationError(
            "env.observation: the filter has no constraints to observe (a CBFActionFilter has)"
        )
    plant = None if isinstance(observer.plant, MujocoPlant) else observer.plant
    return FilterObservation(task, observer.constraints, plant)


def _leased(task: gym.Env[Any, Any], arguments: Mapping[str, Any]) -> LeaseExpiry:
    """The lease around a filter; its clearance, if none is given, is what the filter keeps."""
    budget = arguments.get("budget") or {}
    if "clearance" in budget:
        return LeaseExpiry(task, **arguments)
    constraints = getattr(task, "constraints", [])
    if len(constraints) != 1:
        raise ConfigurationError(
            f"lease: the filter has {len(constraints)} constraints; say which one the lease is made from with "
            "budget: {clearance: {kind: ..., ...}, ...}"
        )
    return LeaseExpiry(task, **{**arguments, "budget": {"clearance": constraints[0], **budget}})


def _function(name: str, where: str) -> Any:
    """What a config calls `module:function`."""
    module_name, _, function = name.partition(":")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise ConfigurationError(
            f"{where}: cannot import {module_name!r}: {error}. Looked among the installed packages and in"
            f" {', '.join(own_folders())}."
        ) from None
    of = f"{module_name} ({getattr(module, '__file__', 'built in')})"
    check_name(function, [name for name in dir(module) if not name.startswith("_")], of)
    return getattr(module, function)
