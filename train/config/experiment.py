"""From the settings of a file to an experiment: what arms inherit, and which settings do not go together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any, Final

from safe_wrappers.errors import ConfigurationError

from .algorithm_settings import HER, check_hyperparameters
from .algorithms import DETERMINISTIC, DISCRETE, MASKED, OFF_POLICY, ON_POLICY
from .models import ArmConfig, ExperimentConfig, default_buffer_size
from .names import check_name
from .types import validate

_EXPERIMENT_KEYS: Final = tuple(field.name for field in fields(ExperimentConfig))
_ARM_KEYS: Final = tuple(field.name for field in fields(ArmConfig) if field.name != "name")
COMMON_KEYS: Final = tuple(key for key in _ARM_KEYS if key not in ("filter", "learner", "start_from"))
"""What may be said for all arms at the top."""


def parse_experiment(settings: Mapping[str, Any]) -> ExperimentConfig:
    """Checks every setting of an experiment.

    Args:
        settings: What `read_config` returned.

    Returns:
        The experiment.

    Raises:
        UnknownNameError: A key, an algorithm or an env id that does not exist.
        ConfigurationError: A value of the wrong type or outside its range, or a missing one.
    """
    for key in settings:
        check_name(key, (*_EXPERIMENT_KEYS, *COMMON_KEYS), "config")
    for key in ("name", "env", "algorithm", "total_steps", "arms", "seeds"):
        if key not in settings:
            raise ConfigurationError(f"config: {key!r} is missing.")
    common = {key: settings[key] for key in COMMON_KEYS if key in settings}
    arms = _mapping(settings["arms"], "arms")
    if not arms:
        raise ConfigurationError("arms: expected at least one, such as `unfiltered: {filter: none}`.")
    own = {key: settings[key] for key in _EXPERIMENT_KEYS if key in settings}
    own["arms"] = tuple(_arm(name, _mapping(arm, f"arms.{name}"), common) for name, arm in arms.items())
    experiment: ExperimentConfig = validate(ExperimentConfig, own, "")
    if len(set(experiment.seeds)) < len(experiment.seeds):
        raise ConfigurationError(f"seeds: each may be given once, got {experiment.seeds}.")
    for arm in experiment.arms:
        _check_start(arm, experiment)
    return replace(experiment, arms=tuple(_with_constraints(arm, experiment) for arm in experiment.arms))


def _mapping(value: Any, where: str) -> dict[str, Any]:
    checked: dict[str, Any] = validate(dict[Any, Any] | None, value, where) or {}
    return checked


def _check_start(arm: ArmConfig, experiment: ExperimentConfig) -> None:
    where = f"arms.{arm.name}.start_from"
    if arm.start_from is None or arm.start_from.endswith(".zip"):
        return
    others = [other.name for other in experiment.arms if other is not arm]
    if not others:
        raise ConfigurationError(
            f"{where}: expected another arm, and there is none, or a file *.zip; got {arm.start_from!r}."
        )
    check_name(arm.start_from, others, f"{where} (an arm, or a file *.zip)")
    chain, source = [arm], experiment.begins_with(arm)
    while source is not None:
        if source in chain:
            names = " <- ".join(each.name for each in [*chain, source])
            raise ConfigurationError(f"{where}: no arm can be trained first: {names}.")
        chain, source = [*chain, source], experiment.begins_with(source)
    if chain[1].algorithm != arm.algorithm:
        raise ConfigurationError(
            f"{where}: {chain[1].name} is trained with {chain[1].algorithm}, this arm with {arm.algorithm}; a policy"
            " goes on with the algorithm that it was trained with."
        )


def _with_constraints(arm: ArmConfig, experiment: ExperimentConfig) -> ArmConfig:
    """With the filter whose constraints judge or are observed: the same one for all arms, to compare them."""
    wanted = [key for key in ("judge", "observation") if getattr(arm.env, key) is not None]
    if not wanted:
        return arm
    chosen = experiment.evaluation_filter
    if chosen.kind == "none":
        instead = ", or use env.cost: module:function" if "judge" in wanted else ""
        raise ConfigurationError(
            f"env.{wanted[0]}: there is no filter whose constraints could be used; give an arm or the evaluation one "
            f"(evaluation: {{filter: protect}}){instead}."
        )
    settings: dict[str, Any] = dict.fromkeys(wanted, replace(chosen, lease=None, escape=None))
    return replace(arm, env=replace(arm.env, **settings))


def _arm(name: str, own: Mapping[str, Any], common: Mapping[str, Any]) -> ArmConfig:
    where = f"arms.{name}"
    for key in own:
        check_name(key, _ARM_KEYS, where)
    hyperparameters = _mapping(own.get("hyperparameters"), f"{where}.hyperparameters")
    if own.get("algorithm", common["algorithm"]) == common["algorithm"]:  # another one's would not fit
        inherited = _mapping(common.get("hyperparameters"), "hyperparameters")
        hyperparameters = {**inherited, **hyperparameters}
    settings = {**common, **own, "hyperparameters": hyperparameters, "name": name}
    arm: ArmConfig = validate(ArmConfig, settings, where, inherited=common.keys() - own.keys())
    checked = check_hyperparameters(arm.algorithm, hyperparameters)
    if arm.algorithm not in ON_POLICY:
        checked.setdefault("buffer_size", default_buffer_size(arm.total_steps))
    arm = replace(arm, hyperparameters=checked)
    _check_actions(arm, where)
    _check_learner(arm, f"{where}.learner")
    _check_replay(arm)
    return arm


def _check_actions(arm: ArmConfig, where: str) -> None:
    if arm.algorithm in DETERMINISTIC and "action_noise" not in arm.hyperparameters:
        raise ConfigurationError(
            f"{where}: the policy of {arm.algorithm} is deterministic and tries nothing out by itself. Give"
            " hyperparameters.action_noise: {normal: 0.1} (a standard deviation of actions scaled to [-1, 1]) or"
            " {ornstein_uhlenbeck: 0.1}; or none, if the random actions of the first `learning_starts` steps are to"
            " be all."
        )


def _check_learner(arm: ArmConfig, where: str) -> None:
    kind = arm.learner.kind
    if arm.learner.of_filter and arm.filter.kind == "none":
        raise ConfigurationError(
            f"{where}: without a filter no action is ever changed, and there is no margin; leave `learner` out, or"
            " give the arm a filter."
        )
    scaled = arm.normalize.observation or arm.normalize.reward
    if arm.learner.cost_limit is not None and scaled and arm.algorithm not in ON_POLICY:
        raise ConfigurationError(
            f"{where}: with normalize {arm.algorithm} stores the env's own rewards, and cost_limit would change"
            f" nothing; leave normalize out, or use {' or '.join(ON_POLICY)}."
        )
    if arm.learner.cost_limit is not None and arm.replays_goals:
        raise ConfigurationError(
            f"{where}: hindsight replay asks the task for rewards anew, without the price of cost_limit; leave"
            " hyperparameters.replay_buffer_class out."
        )
    if arm.algorithm in (*DISCRETE, *MASKED) and (arm.learner.stores_executed or arm.learner.maps):
        raise ConfigurationError(
            f"{where}: {kind} is for continuous actions, and {arm.algorithm} has discrete ones. Use naive or"
            " adaption_penalty."
        )
    if not arm.learner.stores_executed:
        return
    if arm.algorithm in ON_POLICY:
        raise ConfigurationError(
            f"{where}: {arm.algorithm} cannot learn from the executed action: it weighs an action by the probability"
            " with which its policy drew it, and the policy did not draw this one. Use naive or adaption_penalty, or"
            f" {kind} with {', '.join(OFF_POLICY[:-1])} or {OFF_POLICY[-1]}."
        )
    if not arm.replays_goals and "replay_buffer_kwargs" in arm.hyperparameters:
        raise ConfigurationError(
            f"{where}: {kind} sets hyperparameters.replay_buffer_kwargs itself; leave it out, or give"
            f" hyperparameters.replay_buffer_class: {HER} with it."
        )
    if arm.hyperparameters.get("n_steps", 1) > 1:
        raise ConfigurationError(
            f"{where}: {kind} has one-step returns, hyperparameters.n_steps is {arm.hyperparameters['n_steps']}: SB3"
            " makes n-step returns with a buffer of its own. Leave n_steps out, or use naive or adaption_penalty."
        )


def _check_replay(arm: ArmConfig) -> None:
    if not arm.replays_goals:
        return
    if arm.hyperparameters.get("n_steps", 1) > 1:
        raise ConfigurationError(
            f"hyperparameters.n_steps: {HER} has one-step returns, whatever n_steps says; leave it out."
        )
    if arm.env.occlusion is not None:
        raise ConfigurationError(
            f"env.occlusion: {HER} asks the task for the rewards of other goals, and the task does not know of this"
            " penalty: most transitions would go without. Leave one of the two out."
        )
