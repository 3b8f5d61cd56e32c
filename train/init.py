"""What there is to name, `safe-wrappers list`, and a first config of one's own, `safe-wrappers init`."""

from __future__ import annotations

import importlib.util
import inspect
import re
import textwrap
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
from rich.console import Console

import safe_wrappers
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.protect import recipe_names, recipe_of, remedy_for

from .config import parse_experiment, read_config
from .config.algorithms import DETERMINISTIC, DISCRETE, MASKED, OFF_POLICY, ON_POLICY
from .config.types import check_name
from .files import write_text

_FILLED: Final = {"env": "SafePointGoal1-v0", "algorithm": "PPO"}
_RECIPE: Final = 'protect  # this library\'s recipe; for a filter of your own {factory: "module:function"}'
_OF_ITS_OWN: Final = '{{factory: "{module}:filtered"}}  # the function in {module}.py; protect has no recipe'
_TEMPLATE: Final = """\
# Trained without and with the filter, then evaluated on the same episodes:
#   safe-wrappers compare {path} --report
# What is commented out is an example; `safe-wrappers list` has the names, docs/config.md every key.
name: {name}  # the folder below `output`
env: {env}  # an id of gymnasium.make; {{id: ..., kwargs: {{...}}}} with arguments of the env
algorithm: {algorithm}
total_steps: 100_000  # of all envs together, rounded up to whole rollouts
n_envs: 4
#vec_env: subproc  # each env in a process of its own
#action_repeat: 4  # control steps for which the policy holds an action; the filter checks each
#normalize: {{observation: true}}
{hyperparameters}  # by SB3's names; `linear_3e-4`: falls to 0 over total_steps
arms:  # what is compared
  unfiltered: {{filter: none}}
  filtered:
    filter: {filter}
    #learner: {{kind: adaption_penalty, penalty: 0.1}}  # what the learner sees of a changed action
seeds: [0]  # every arm is trained with each
#workers: 2  # runs at a time; by default one per core
#checkpoint_every: 10_000
evaluation: {{episodes: 20}}
"""
_MODULE: Final = """\
import safe_wrappers as sw

{given}
def filtered(env):
{body}
"""
_OPEN: Final = '''\
horizon = 20  # steps to look ahead
backup = {backup!r}  # or a function of the observation: the action that keeps h positive


def h(observation):
    """What must stay positive."""
    raise sw.errors.ConfigurationError("say in {module} what must stay positive, by h(observation)")

'''


def init_command(path: Path, overrides: Sequence[str], console: Console) -> None:
    """Writes a commented config, for an env without a recipe with a module of its filter beside it.

    Args:
        path: The file.
        overrides: `env=ID` and `algorithm=NAME`.
        console: Where it is told.

    Raises:
        ConfigurationError: A file exists, or what the config would say is refused: the env cannot be made, no filter
            fits it, or the algorithm does not.
    """
    from .run.model import check_task
    from .run.stack import make_env

    filled = dict(_FILLED)
    for override in overrides:
        key, _, value = override.partition("=")
        filled[check_name(key, _FILLED, "init")] = value
    module = path.parent / f"{re.sub(r'[^A-Za-z0-9_]', '_', path.stem)}_filter.py"
    env = make_env(filled["env"], {})
    known = env.spec is not None and recipe_of(env.spec.id) is not None
    code = "" if known else filter_module(env, module.name)
    for written in [path, *([module] if code else [])]:
        if written.exists():
            raise ConfigurationError(
                f"{str(written)!r} is there already; give another name: safe-wrappers init NAME.yaml"
            )
    noisy = filled["algorithm"] in DETERMINISTIC  # they need a word on it
    noise, rate = (
        "hyperparameters: {action_noise: {normal: 0.1}}",
        "#hyperparameters: {learning_rate: 1e-4}",
    )
    chosen = _OF_ITS_OWN.format(module=module.stem) if code else _RECIPE
    given = {"hyperparameters": noise if noisy else rate, "filter": chosen, **filled}
    write_text(path, _TEMPLATE.format(name=path.stem, path=path, **given))
    try:
        for arm in parse_experiment(read_config(path)).arms:
            check_task(arm, env)
        if not code:
            safe_wrappers.protect(env)
    except ConfigurationError:
        path.unlink()
        raise
    console.print(f"Written: {path}", soft_wrap=True, highlight=False)
    if code:
        write_text(module, code)
        words = f"Written: {module}, the filter of the arm `filtered`, to be adapted"
        console.print(words, soft_wrap=True, highlight=False)


def filter_module(env: gym.Env[Any, Any], name: str) -> str:
    """The text of a module whose function `filtered` filters an env that `protect` has no recipe for.

    Args:
        env: Without a filter; the lines are tried on it.
        name: The module's file name.

    Raises:
        ConfigurationError: No filter fits the env.
    """
    remedy = remedy_for(env, env)
    backup = "zero" if isinstance(env.action_space, gym.spaces.Box) else "hold"
    *lines, last = remedy.code.splitlines()
    body = textwrap.indent("\n".join([*lines, f"return {last.removeprefix('env = ')}"]), "    ")
    given = _OPEN.format(module=name, backup=backup) if remedy.is_open else ""
    return _MODULE.format(given=given, body=body)


def list_command(kinds: Sequence[str], console: Console) -> None:
    """Prints what there is, of all kinds or of those that are named.

    Raises:
        UnknownNameError: There is no such kind.
    """
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


def _recipes() -> dict[str, str]:
    ids = Counter(recipe_of(name) for name in _envs())
    return {name: f"{ids[name]} ids" if ids[name] else "not installed here" for name in recipe_names()}


def _wrappers() -> dict[str, str]:
    named = {name: getattr(safe_wrappers, name) for name in safe_wrappers.__all__}
    wrappers = gym.Wrapper | gym.vector.VectorWrapper
    found = {n: thing for n, thing in named.items() if inspect.isclass(thing) and issubclass(thing, wrappers)}
    found |= {f"faults.{name}": thing for name, thing in safe_wrappers.faults.FAULTS.items()}
    return {name: (inspect.getdoc(thing) or "").partition("\n")[0] for name, thing in sorted(found.items())}


def _algorithms() -> dict[str, str]:
    rows = dict.fromkeys(ON_POLICY, "any actions")
    rows |= dict.fromkeys(OFF_POLICY, "continuous actions, replay buffer")
    rows |= dict.fromkeys(DISCRETE, "discrete actions, replay buffer")
    return rows | dict.fromkeys(MASKED, "discrete actions, asks for masks")


def _configs() -> dict[str, str]:
    """Experiments in this folder and in `configs/`, each with the first line of its comment."""
    rows = {}
    for path in sorted([*Path().glob("*.yaml"), *Path("configs").glob("*.yaml")]):
        try:
            settings = read_config(path)
        except ConfigurationError:
            continue
        if "arms" in settings:
            lines = path.read_text(encoding="utf-8").strip().splitlines()
            first = next(line for line in lines if not line.startswith("# yaml-language-server:"))
            rows[str(path)] = first.lstrip("# ") if first.startswith("#") else ""
    return rows


_LISTS: Final[Mapping[str, Callable[[], dict[str, str]]]] = {
    "envs": _envs,
    "recipes": _recipes,
    "wrappers": _wrappers,
    "algorithms": _algorithms,
    "configs": _configs,
}
