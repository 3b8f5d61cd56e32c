"""From a YAML file and overrides to an experiment: what arms inherit, and which settings do not go together."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Final

import yaml

from safe_wrappers.errors import ConfigurationError

from .algorithms import DETERMINISTIC, DISCRETE, OFF_POLICY, ON_POLICY, SBX, check_hyperparameters
from .models import ArmConfig, ExperimentConfig
from .types import check_name, validate

_EXPERIMENT_KEYS: Final = tuple(field.name for field in fields(ExperimentConfig))
_ARM_KEYS: Final = tuple(field.name for field in fields(ArmConfig) if field.name != "name")
COMMON_KEYS: Final = tuple(key for key in _ARM_KEYS if key not in ("filter", "learner"))
"""What may be said for all arms at the top."""


class _Loader(yaml.SafeLoader):
    """YAML 1.1 as people mean it: `3e-4` is a number, and a key given twice is a mistake."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[object] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str) or key in seen:
                why = f"{key!r} is given twice" if isinstance(key, str) else f"{key!r} is no text"
                raise yaml.constructor.ConstructorError(None, None, why, key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep)


# PyYAML reads 3e-4 as a string (it wants 3.0e-4): a learning rate that is silently no number.
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?[0-9]+[eE][-+]?[0-9]+$"), list("-+0123456789")
)


def read_config(path: Path, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Reads a config file and applies overrides such as `total_steps=1000` or `arms.filtered.filter=protect`.

    Args:
        path: The YAML file.
        overrides: `dotted.key=value` texts; values are read as YAML. Later ones win.

    Returns:
        The settings, unchecked.

    Raises:
        ConfigurationError: No such file, not YAML, not a mapping, or an override that is not `key=value`.
    """
    if not path.is_file():
        raise ConfigurationError(f"There is no config file {str(path)!r}.")
    settings = _load(path.read_bytes(), str(path))
    if not isinstance(settings, dict):
        raise ConfigurationError(
            f"{path}: expected a mapping of settings (`key: value` lines), got {settings!r}."
        )
    for override in overrides:
        key, equals, value = override.partition("=")
        if not equals or not key:
            raise ConfigurationError(f"Override {override!r}: expected key=value, such as total_steps=1000.")
        set_value(settings, key, _load(value, f"override {override!r}"))
    return settings


def _load(content: str | bytes, where: str) -> Any:
    try:
        # By way of JSON, so that aliases share nothing and that there are texts, numbers, lists and mappings alone.
        return json.loads(json.dumps(yaml.load(content, _Loader)))
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        raise ConfigurationError(f"{where}: not valid YAML, or no settings: {error}") from None


_SHORT: Final[Mapping[str, Callable[[str], dict[str, Any]]]] = {
    "env": lambda text: {"id": text},
    "learner": lambda text: {"kind": text},
    "filter": lambda text: {} if text == "none" else {text: {}},
}


def set_value(settings: dict[str, Any], key: str, value: Any) -> None:
    """Gives a setting another value, in place."""
    *outer, last = key.split(".")
    for name in outer:
        inner = settings.get(name)
        if inner is None:  # `arms: {filtered:}` is an empty mapping in disguise
            inner = settings[name] = {}
        if isinstance(inner, str) and name in _SHORT:  # a text that stands for a section
            inner = settings[name] = _SHORT[name](inner)
        if not isinstance(inner, dict):
            raise ConfigurationError(f"{key}: {name} is {inner!r}, with no keys inside.")
        settings = inner
    settings[last] = value


def parse_experiment(settings: Mapping[str, Any]) -> ExperimentConfig:
    """Checks every setting of an experiment.

    Args:
        settings: What `read_config` returned.

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
    return replace(experiment, arms=tuple(_with_constraints(arm, experiment) for arm in experiment.arms))


def _mapping(value: Any, where: str) -> dict[str, Any]:
    checked: dict[str, Any] = validate(dict[Any, Any] | None, value, where) or {}
    return checked


def _arm(name: str, own: Mapping[str, Any], common: Mapping[str, Any]) -> ArmConfig:
    where = f"arms.{name}"
    for key in own:
        check_name(key, _ARM_KEYS, where)
    hyperparameters = _mapping(own.get("hyperparameters"), f"{where}.hyperparameters")
    if own.get("algorithm", common["algorithm"]) == common["algorithm"]:  # another one's would not fit
        hyperparameters = {**_mapping(common.get("hyperparameters"), "hyperparameters"), **hyperparameters}
    settings = {**common, **own, "hyperparameters": hyperparameters, "name": name}
    arm: ArmConfig = validate(ArmConfig, settings, where)
    arm = replace(arm, hyperparameters=check_hyperparameters(arm.algorithm, hyperparameters))
    for wrong, why in _conflicts(arm):
        if wrong:
            raise ConfigurationError(f"{where}: {why}")
    return arm


def _conflicts(arm: ArmConfig) -> list[tuple[bool, str]]:
    """What does not go together, and why."""
    learner, given = arm.learner, arm.hyperparameters
    scaled = arm.normalize.observation or arm.normalize.reward
    discrete, on_policy = arm.algorithm in DISCRETE, arm.algorithm in ON_POLICY
    return [
        (
            arm.algorithm in DETERMINISTIC and "action_noise" not in given,
            f"the policy of {arm.algorithm} is deterministic and tries nothing out by itself. Give"
            " hyperparameters.action_noise: {normal: 0.1} (a standard deviation of actions scaled to [-1, 1]),"
            " {ornstein_uhlenbeck: 0.1} or none.",
        ),
        (
            learner.kind != "naive" and arm.filter.kind == "none",
            "without a filter no action is ever changed; leave `learner` out, or give the arm a filter.",
        ),
        (
            learner.cost_limit is not None and scaled and not on_policy,
            f"with normalize {arm.algorithm} stores the env's own rewards, and learner.cost_limit would change"
            f" nothing; leave normalize out, or use {' or '.join(ON_POLICY)}.",
        ),
        (
            discrete and learner.stores_executed,
            f"learner {learner.kind} is for continuous actions, and {arm.algorithm} has discrete ones. Use naive or"
            " adaption_penalty.",
        ),
        (
            learner.stores_executed and on_policy,
            f"{arm.algorithm} cannot learn from the executed action: it weighs an action by the probability with"
            " which its policy drew it, and the policy did not draw this one. Use naive or adaption_penalty, or"
            f" {learner.kind} with {', '.join(OFF_POLICY)}.",
        ),
        (
            learner.stores_executed and given.get("n_steps", 1) > 1,
            f"learner {learner.kind} has one-step returns; leave hyperparameters.n_steps out.",
        ),
        (
            arm.algorithm == "sbx.PPO" and not given.keys().isdisjoint(("clip_range_vf", "target_kl")),
            "sbx.PPO does nothing with clip_range_vf, and a run that goes on would forget the learning rate that"
            " target_kl adapts. Leave hyperparameters.clip_range_vf and target_kl out.",
        ),
        (
            arm.algorithm == "sbx.CrossQ" and isinstance(given.get("learning_rate"), str),
            "the learning rate of sbx.CrossQ cannot fall; give hyperparameters.learning_rate as a number.",
        ),
        (
            arm.algorithm.startswith(SBX) and arm.device != "cpu",
            f"device is torch's; {arm.algorithm} computes where the environment variable JAX_PLATFORMS says, on the"
            " CPU without one. Leave device out.",
        ),
    ]


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
    settings: dict[str, Any] = dict.fromkeys(wanted, replace(chosen, lease=None, stuck=None))
    return replace(arm, env=replace(arm.env, **settings))
