"""The envs of one run, each a whole stack: from the task to SB3's Monitor, with the learner's penalty."""

from __future__ import annotations

import functools
import pkgutil
from collections.abc import Callable, Mapping
from typing import Any, Final, SupportsFloat

import gymnasium as gym
import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from safe_wrappers import info as keys
from safe_wrappers.errors import ConfigurationError, SafeWrappersError, UnsupportedEnvError
from safe_wrappers.filter.bound import Bound
from safe_wrappers.filter.constraint import Memory
from safe_wrappers.filter.engine import SafetyFilter
from safe_wrappers.plants import MujocoPlant, default_plant
from safe_wrappers.wrappers.cbf_action_filter import filter_inside
from safe_wrappers.wrappers.faults import FAULTS
from safe_wrappers.wrappers.learner import ActionRepeat, AdaptionPenalty, FilterObservation, StuckMonitor
from safe_wrappers.wrappers.lease_expiry import LeaseExpiry
from safe_wrappers.wrappers.occlusion import OcclusionPenalty
from safe_wrappers.wrappers.protect import protect
from safe_wrappers.wrappers.recording import CostFunction, RecordInterventions, refuse_own_cost

from ..config.models import NAIVE, ArmConfig, EnvConfig, FilterConfig, LearnerConfig, check_env_id
from ..config.types import check_name

_TOLERANCE: Final = 1e-6
"""h below zero by less is rounding, in the constraints' own units; the filter's `cbf/unsafe` has the same."""


def make_vec_env(arm: ArmConfig) -> VecEnv:
    """Makes `arm.n_envs` envs, one after the other in this process."""
    return DummyVecEnv([functools.partial(make_training_env, arm)] * arm.n_envs)


def make_training_env(arm: ArmConfig) -> gym.Env[Any, Any]:
    """One env as the arm trains in it."""
    env = make_stack(arm.env, arm.filter, arm.learner)
    return env if arm.action_repeat == 1 else ActionRepeat(env, arm.action_repeat)


def make_env(env_id: str, kwargs: Mapping[str, Any]) -> gym.Env[Any, Any]:
    """Makes an env by the id and the arguments of a config.

    Raises:
        ConfigurationError: It cannot be made; whatever its own constructor says of its arguments.
    """
    check_env_id(env_id)  # a spawned process has not yet registered what the first one did
    try:
        return gym.make(env_id, **kwargs)
    except SafeWrappersError:
        raise
    except Exception as error:
        of = f" with kwargs {dict(kwargs)}" if kwargs else ""
        raise ConfigurationError(
            f"env: {env_id}{of} cannot be made: {type(error).__name__}: {error}"
        ) from error


def make_stack(
    env: EnvConfig,
    action_filter: FilterConfig,
    learner: LearnerConfig = NAIVE,
    render_mode: str | None = None,
) -> gym.Env[Any, Any]:
    """Makes the task with all its layers, from the judge to SB3's Monitor.

    The recorder counts the task's own reward, whatever the learner sees. Monitor does too, but for OcclusionPenalty,
    which is inside of it. Evaluation has no `learner`, so that no return ever holds a penalty.
    """
    kwargs = env.kwargs if render_mode is None else {**env.kwargs, "render_mode": render_mode}
    task = make_env(env.id, kwargs)
    if env.cost is not None:
        task = CostFunction(task, env.cost)
    if env.judge is not None:
        task = ConstraintJudge(task, _filtered(task, env.judge))
    if env.occlusion is not None:
        task = _called("env.occlusion", OcclusionPenalty, task, env.occlusion)
    observed = None if env.observation is None else _filtered(task, env.observation)
    task = _filtered(task, action_filter)
    if action_filter.lease is not None:
        task = _leased(task, action_filter.lease)
    if observed is not None:
        task = _with_features(task, observed)
    if action_filter.stuck is not None:
        task = _called("filter.stuck", StuckMonitor, task, action_filter.stuck)
    recorded: gym.Env[Any, Any] = RecordInterventions(task)
    for name, arguments in env.faults.items():
        fault = FAULTS[check_name(name, FAULTS, "env.faults")]
        recorded = _called(f"env.faults.{name}", fault, recorded, arguments)
    monitored = Monitor(recorded)
    return AdaptionPenalty(monitored, learner.penalty) if learner.penalised else monitored


def _called(
    where: str, make: Callable[..., gym.Env[Any, Any]], env: gym.Env[Any, Any], given: Mapping[str, Any]
) -> gym.Env[Any, Any]:
    """What is made around an env; arguments that are missing or unknown are refused."""
    try:
        return make(env, **given)
    except TypeError as error:
        raise ConfigurationError(f"{where}: {error}") from error


def _filtered(task: gym.Env[Any, Any], action_filter: FilterConfig) -> gym.Env[Any, Any]:
    """The task in its filter; as it is if there is none."""
    if action_filter.protect is not None:
        try:
            return _called("filter.protect", protect, task, action_filter.protect)
        except UnsupportedEnvError as error:
            raise ConfigurationError(
                f"filter: {error}\nPut these lines into a function of the env, in a module beside the config; then"
                ' filter: {factory: "module:function"}.'
            ) from None
    if action_filter.factory is not None:
        made = _called("filter.kwargs", _factory(action_filter.factory), task, action_filter.kwargs)
        if not isinstance(made, gym.Env):
            raise ConfigurationError(
                f"filter.factory: {action_filter.factory} must return the env, filtered; got {made!r}"
            )
        return made
    return task


def _with_features(task: gym.Env[Any, Any], observed: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
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


def _leased(task: gym.Env[Any, Any], arguments: Mapping[str, Any]) -> gym.Env[Any, Any]:
    """The lease around a filter; its clearance, if none is given, is what the filter keeps."""
    budget = arguments.get("budget") or {}
    if "clearance" not in budget:
        constraints = getattr(task, "constraints", [])
        if len(constraints) != 1:
            raise ConfigurationError(
                f"lease: the filter has {len(constraints)} constraints; say which one the lease is made from with "
                "budget: {clearance: {kind: ..., ...}, ...}"
            )
        budget = {"clearance": constraints[0], **budget}
    return _called("filter.lease", LeaseExpiry, task, {**arguments, "budget": budget})


def _factory(name: str) -> Any:
    """What a config calls `module:function`."""
    try:
        return pkgutil.resolve_name(name)
    except (ImportError, AttributeError) as error:
        raise ConfigurationError(
            f"filter.factory: cannot import {name!r}: {error}. Modules beside the config and in the working folder"
            " are found, too."
        ) from None


class ConstraintJudge(gym.Wrapper[Any, Any, Any, Any]):
    """Writes ``info["cost"]``: 1 where some constraint's h is negative at the end of the step, else 0.

    h is read from the env's true state, to the limit itself (a constraint's margin is not taken off): of a MuJoCo
    env through a plant of its own on the env's own model, whatever model and delay the filter has. So it judges in
    the same way whether the filter is on or not. It sees what the constraints speak of, and nothing else.

    Args:
        task: Reports no cost.
        judging: The filter around the same task, whose constraints are used; it is never stepped.

    Raises:
        ConfigurationError: It is no CBFActionFilter, one of them has no h (`h_along`), or the filter
            has a plant of the user's own with a delay, which does not see the present state.
    """

    def __init__(self, task: gym.Env[Any, Any], judging: gym.Env[Any, Any]) -> None:
        super().__init__(task)
        if not judging.has_wrapper_attr("filter"):
            raise ConfigurationError(
                "env.judge: the filter has no constraints and plant that could judge (a CBFActionFilter has); use "
                "env.cost: module:function"
            )
        its_filter: SafetyFilter = judging.get_wrapper_attr("filter")
        for constraint in its_filter.bound:
            if not constraint.measures_state:
                kind = type(constraint.spec).__name__
                raise ConfigurationError(
                    f"env.judge: {kind} has no h (`h_along`) and cannot judge; use env.cost: module:function"
                )
        self._plant = its_filter.plant
        self._constraints = its_filter.bound
        if isinstance(self._plant, MujocoPlant):
            self._plant = default_plant(task)
            self._plant.bind(task)
            self._constraints = [Bound(constraint, self._plant) for constraint in its_filter.constraints]
        elif self._plant.delay_s:
            raise ConfigurationError(
                f"env.judge: the filter's plant looks {self._plant.delay_s} s ahead and does not see the present "
                "state; use env.cost: module:function"
            )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Resets the env; info has the cost of the state in which the episode starts."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._plant.executed(None)
        self._memories: list[Memory] = [{} for _ in self._constraints]
        self._judge(observation, info)
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Steps the env and judges where it is now."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._judge(observation, info)
        return observation, reward, terminated, truncated, info

    def _judge(self, observation: Any, info: dict[str, Any]) -> None:
        refuse_own_cost(self.unwrapped, info)
        self._plant.received(observation, info)
        self._plant.observe()
        cost, still = 0.0, np.zeros(self._plant.lower.size)
        for i, constraint in enumerate(self._constraints):
            constraint.observe(self._memories[i])
            # Negated, so that an h that is not a number is a violation.
            cost = max(cost, float(not (constraint.value() >= -_TOLERANCE).all()))
            self._memories[i] = constraint.executed(still)
        info[keys.COST] = cost
