"""What there is to name: envs, recipes, wrappers, algorithms, configs."""

from __future__ import annotations

import importlib.util
import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

import gymnasium as gym
from rich.console import Console
from rich.markup import escape

import safe_wrappers
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.protect import recipe_names, recipe_of

from .config.algorithms import DISCRETE, MASKED, OFF_POLICY, ON_POLICY
from .config.file import read_config
from .config.names import check_name

Rows = dict[str, str]
"""Name -> what is to be said of it."""


def list_command(kinds: Sequence[str], console: Console) -> None:
    """Prints what there is, of all kinds or of those that are named.

    Raises:
        UnknownNameError: There is no such kind.
    """
    chosen = [check_name(kind, LISTS, "list") for kind in kinds] or list(LISTS)
    for kind in chosen:
        rows = LISTS[kind]()
        console.print(f"[bold]{kind}[/bold] ({len(rows)})", highlight=False)
        width = max(map(len, rows), default=0)
        for name, words in rows.items():
            line = f"  {name:{width}}  {words}".rstrip()
            console.print(escape(line), highlight=False, soft_wrap=True)


def _envs() -> Rows:
    """This library's own tasks, and others that `protect` knows and that are installed, in their newest version."""
    if importlib.util.find_spec("gymnasium_robotics") is not None:
        gym.register_envs(importlib.import_module("gymnasium_robotics"))
    own = [name for name, spec in gym.registry.items() if str(spec.entry_point).startswith("safe_wrappers.")]
    rows = {name: "of this library" for name in sorted(own)}
    newest: dict[tuple[str | None, str], gym.envs.registration.EnvSpec] = {}
    for name, spec in gym.registry.items():
        if name not in rows and recipe_of(name) is not None:
            other = newest.setdefault((spec.namespace, spec.name), spec)
            if (spec.version or 0) > (other.version or 0):
                newest[spec.namespace, spec.name] = spec
    known = sorted(spec.id for spec in newest.values())
    return rows | {name: f"recipe {recipe_of(name)}" for name in known}


def _recipes() -> Rows:
    ids: dict[str, int] = {}
    for name in _envs():
        recipe = recipe_of(name)
        if recipe is not None:
            ids[recipe] = ids.get(recipe, 0) + 1
    return {
        name: f"{ids[name]} id{'s' * (ids[name] > 1)}" if name in ids else "not installed here"
        for name in recipe_names()
    }


def _wrappers() -> Rows:
    named = {name: getattr(safe_wrappers, name) for name in safe_wrappers.__all__}
    wrappers = gym.Wrapper | gym.vector.VectorWrapper
    found = {n: thing for n, thing in named.items() if inspect.isclass(thing) and issubclass(thing, wrappers)}
    found |= {f"faults.{name}": thing for name, thing in safe_wrappers.faults.FAULTS.items()}
    return {name: _first_line(thing) for name, thing in sorted(found.items())}


def _algorithms() -> Rows:
    continuous, either, discrete = (
        "continuous actions, replay buffer",
        "any actions",
        "discrete actions, replay buffer",
    )
    rows = dict.fromkeys(ON_POLICY, either) | dict.fromkeys(OFF_POLICY, continuous)
    return (
        rows | dict.fromkeys(DISCRETE, discrete) | dict.fromkeys(MASKED, "discrete actions, asks for masks")
    )


def _configs() -> Rows:
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


def _first_line(thing: object) -> str:
    return (inspect.getdoc(thing) or "").partition("\n")[0]


LISTS: Final[Mapping[str, Callable[[], Rows]]] = {
    "envs": _envs,
    "recipes": _recipes,
    "wrappers": _wrappers,
    "algorithms": _algorithms,
    "configs": _configs,
}
