"""Env ids, also those of gymnasium-robotics, which registers its own only when it is imported."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Mapping
from typing import Any

import gymnasium as gym

from safe_wrappers.errors import ConfigurationError, SafeWrappersError

from .types import check_name


def check_env_id(env_id: str) -> str:
    """Returns the id; refuses one that no installed package registers.

    Imports gymnasium-robotics if it may be one of its ids. An id of the form `module:Id-v0` is left to
    `gymnasium.make`, which imports the module.

    Raises:
        UnknownNameError: An id that nobody registers; holds the nearest one.
    """
    if ":" in env_id or _registered(env_id):
        return env_id
    if importlib.util.find_spec("gymnasium_robotics") is not None:
        gym.register_envs(importlib.import_module("gymnasium_robotics"))  # its import registers them
    return env_id if _registered(env_id) else check_name(env_id, gym.registry)


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


def _registered(env_id: str) -> bool:
    try:
        gym.spec(env_id)
    except gym.error.Error:
        return False
    return True
