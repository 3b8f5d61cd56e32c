"""A filter of one's own for an env that `protect` has no recipe for, as the module that a config names."""

from __future__ import annotations

import textwrap
from typing import Any, Final

import gymnasium as gym

from safe_wrappers.by_hand import Remedy, remedy_for
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.env_checks import name_of
from safe_wrappers.protect import recipe_of

_IMPORT: Final = "import safe_wrappers as sw\n\n"
_OPEN: Final = """\
horizon = 20  # steps to look ahead
backup = {backup!r}  # or a function of the observation: the action that keeps h positive


def h(observation):
    \"\"\"What must stay positive.\"\"\"
    raise sw.errors.ConfigurationError("say in {module} what must stay positive, by h(observation)")

"""


def is_known(env: gym.Env[Any, Any]) -> bool:
    """Whether `protect` has a recipe for the env."""
    return env.spec is not None and recipe_of(env.spec.id) is not None


def filter_module(env: gym.Env[Any, Any], name: str) -> str:
    """The text of a module whose function `filtered` filters the env.

    Args:
        env: Without a filter; the lines are tried on it.
        name: The module's file name.

    Raises:
        ConfigurationError: No filter fits the env.
    """
    remedy = _remedy(env)
    backup = "zero" if isinstance(env.action_space, gym.spaces.Box) else "hold"
    given = _OPEN.format(module=name, backup=backup) if remedy.is_open else ""
    return f"{_IMPORT}{given}\n{_function(remedy)}"


def refuse_without_recipe(env: gym.Env[Any, Any]) -> None:
    """Refuses `filter: protect` for an env without a recipe; the message has the filter to take instead."""
    if is_known(env):
        return
    remedy = _remedy(env)
    says = f" {remedy.says}." if remedy.is_open else ""
    raise ConfigurationError(
        f"filter: protect has no recipe for {name_of(env)}. Write a module beside the config, such as my_filter.py,\n"
        f"{textwrap.indent(_IMPORT + _function(remedy), '    ')}"
        f'and name its function: filter: {{factory: "my_filter:filtered"}}.{says}'
    )


def _remedy(env: gym.Env[Any, Any]) -> Remedy:
    try:
        return remedy_for(env, env)
    except ConfigurationError as error:
        raise ConfigurationError(
            f"protect has no recipe for {name_of(env)}, and no filter fits it: {error}"
        ) from error


def _function(remedy: Remedy) -> str:
    *lines, last = remedy.code.splitlines()
    body = "\n".join([*lines, f"return {last.removeprefix('env = ')}"])
    return f"def filtered(env):\n{textwrap.indent(body, '    ')}\n"
