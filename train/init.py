"""What there is to name, `safe-wrappers list`, and a first config of one's own, `safe-wrappers init`."""

from __future__ import annotations

import importlib.util
import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

import gymnasium as gym
from rich.console import Console

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.wrappers.faults import FAULTS
from safe_wrappers.wrappers.recipes import EVERY, recipe_of

from .config import parse_experiment, read_config
from .config.algorithms import DETERMINISTIC, DISCRETE, OFF_POLICY, ON_POLICY
from .config.types import check_name
from .files import write_text

_FILLED: Final = {"env": "SafePointGoal1-v0", "algorithm": "PPO"}
_TEMPLATE: Final = """\
# Trained without and with the filter, then evaluated on the same episodes:
#   safe-wrappers compare {path} --report
# What is commented out is an example; `safe-wrappers list` has the names, docs/config.md every key.
name: {name}  # the folder below `output`
env: {env}  # an id of gymnasium.make; {{id: ..., kwargs: {{...}}}} with arguments of the env
algorithm: {algorithm}
total_steps: 100_000  # of all envs together, rounded up to whole rollouts
n_envs: 4
#action_repeat: 4  # control steps for which the policy holds an action; the filter checks each
#normalize: {{observation: true}}
{hyperparameters}  # by SB3's names; `linear_3e-4`: falls to 0 over total_steps
arms:  # what is compared
  unfiltered: {{filter: none}}
  filtered:
    filter: protect  # this library's recipe; for a filter of your own {{factory: "module:function"}}
    #learner: {{kind: adaption_penalty, penalty: 0.1}}  # what the learner sees of a changed action
seeds: [0]  # every arm is trained with each
#workers: 2  # runs at a time; by default one per core
#checkpoint_every: 10_000
evaluation: {{episodes: 20}}
"""


def init_command(path: Path, overrides: Sequence[str], console: Console) -> None:
    """Writes a commented config.

    Raises:
        ConfigurationError: The file exists, or what the config would say is refused: the env cannot be made, the
            algorithm does not fit it, or there is no recipe for it; the message has the lines that filter it then.
    """
    from .run.model import check_task
    from .run.stack import make_stack

    if path.exists():
        raise ConfigurationError(
            f"{str(path)!r} is there already; give another name: safe-wrappers init NAME.yaml"
        )
    filled = dict(_FILLED)
    for override in overrides:
        key, _, value = override.partition("=")
        filled[check_name(key, _FILLED, "init")] = value
    noisy = filled["algorithm"] in DETERMINISTIC  # they need a word on it
    filled["hyperparameters"] = (
        "hyperparameters: {action_noise: {normal: 0.1}}"
        if noisy
        else "#hyperparameters: {learning_rate: 1e-4}"
    )
    write_text(path, _TEMPLATE.format(name=path.stem, path=path, **filled))
    try:
        for arm in parse_experiment(read_config(path)).arms:
            env = make_stack(arm.env, arm.filter)
            check_task(arm, env)
            env.close()
    except ConfigurationError:
        path.unlink()
        raise
    console.print(f"Written: {path}", soft_wrap=True, highlight=False)


def list_command(kinds: Sequence[str], console: Console) -> None:
    """Prints what there is, of all kinds or of those that are named."""
    for kind in [check_name(kind, _LISTS, "list") for kind in kinds] or _LISTS:
        rows = _LISTS[kind]()
        console.print(f"[bold]{kind}[/bold] ({len(rows)})", highlight=False)
        width = max(map(len, rows), default=0)
        for name, words in rows.items():
            console.print(
                f"  {name:{width}}  {words}".rstrip(), highlight=False, soft_wrap=True, markup=False
            )


def _envs() -> dict[str, str]:
    """This library's own tasks, and others that `protect` knows and that are installed, in their newest version."""
    if importlib.util.find_spec("gymnasium_robotics") is not None:
        gym.register_envs(importlib.import_module("gymnasium_robotics"))
    own = [name for name, spec in gym.registry.items() if str(spec.entry_point).startswith("safe_wrappers.")]
    newest = {}
    for spec in sorted(gym.registry.values(), key=lambda spec: spec.version or 0):
        if spec.id not in own and recipe_of(spec.id) is not None:
            newest[spec.namespace, spec.name] = spec.id
    rows = {name: "of this library" for name in sorted(own)}
    return rows | {name: f"recipe {recipe_of(name)}" for name in sorted(newest.values())}


def _wrappers() -> dict[str, str]:
    package = importlib.import_module("safe_wrappers")
    named = {name: getattr(package, name) for name in package.__all__}
    wrappers = gym.Wrapper | gym.vector.VectorWrapper
    found = {n: thing for n, thing in named.items() if inspect.isclass(thing) and issubclass(thing, wrappers)}
    found |= {f"faults.{name}": thing for name, thing in FAULTS.items()}
    return {name: (inspect.getdoc(thing) or "").partition("\n")[0] for name, thing in sorted(found.items())}


def _algorithms() -> dict[str, str]:
    rows = dict.fromkeys(ON_POLICY, "any actions")
    rows |= dict.fromkeys(OFF_POLICY, "continuous actions, replay buffer")
    return rows | dict.fromkeys(DISCRETE, "discrete actions, replay buffer")


_LISTS: Final[Mapping[str, Callable[[], dict[str, str]]]] = {
    "envs": _envs,
    "recipes": lambda: dict.fromkeys(EVERY, ""),
    "wrappers": _wrappers,
    "algorithms": _algorithms,
}
