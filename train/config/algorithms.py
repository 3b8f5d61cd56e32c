"""Which algorithms a config can name, and their hyperparameters. Imported when used: torch takes seconds."""

from __future__ import annotations

import importlib
import inspect
import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

from pydantic import BeforeValidator, Field, StrictBool

from safe_wrappers.errors import ConfigurationError

from .types import Count, Integer, NonNegative, Number, check_name, matching, validate

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

_MODULES: Final = {
    **dict.fromkeys(("PPO", "A2C", "SAC", "TD3", "DDPG", "DQN"), "stable_baselines3"),
    **dict.fromkeys(("TQC", "CrossQ", "TRPO", "QRDQN"), "sb3_contrib"),
    **dict.fromkeys(("sbx.PPO", "sbx.SAC", "sbx.TD3", "sbx.TQC", "sbx.CrossQ"), "sbx"),
}
_EXTRAS: Final = {"sb3_contrib": "contrib", "sbx": "sbx"}
SBX: Final = "sbx."
"""Before the names of algorithms that compute in JAX."""
ON_POLICY: Final = ("PPO", "A2C", "TRPO", "sbx.PPO")
"""They learn from what they have just done, continuous actions or discrete ones."""
OFF_POLICY: Final = ("SAC", "TD3", "DDPG", "TQC", "CrossQ", "sbx.SAC", "sbx.TD3", "sbx.TQC", "sbx.CrossQ")
"""They learn from a replay buffer, continuous actions."""
DISCRETE: Final = ("DQN", "QRDQN")
"""They learn from a replay buffer, discrete actions; their filter is an ActionShield."""
DETERMINISTIC: Final = ("TD3", "DDPG", "sbx.TD3")
"""Of `OFF_POLICY` those whose policy tries nothing out by itself."""
LINEAR: Final = "linear_"
SCHEDULED: Final = ("learning_rate", "clip_range", "clip_range_vf")
"""What may fall in the course of a run: a number, or a text such as `linear_3e-4`."""
# What the run itself decides; the rest of the constructor's arguments are hyperparameters.
_NOT_HYPERPARAMETERS: Final = {"self", "env", "seed", "device", "verbose", "tensorboard_log"} | {
    "_init_setup_model",
    "stats_window_size",
    "replay_buffer_class",
    "replay_buffer_kwargs",
}
_Noise = Annotated[
    dict[Literal["normal", "ornstein_uhlenbeck"], Annotated[Number, Field(gt=0)]],
    Field(min_length=1, max_length=1),
]
"""A standard deviation of actions scaled to [-1, 1]."""
_OF_DEFAULT: Final[Mapping[type, Any]] = {bool: StrictBool, int: Integer, float: Number}
_TYPES: Final[Mapping[str, Any]] = {
    **dict.fromkeys(("learning_rate", "qf_learning_rate"), Annotated[Number, Field(gt=0)]),
    "action_noise": Annotated[
        _Noise | None, BeforeValidator(lambda given: None if given == "none" else given)
    ],
    "train_freq": Any,  # may be [4, "episode"]
    **dict.fromkeys(("n_steps", "batch_size", "n_epochs", "buffer_size"), Count),
    **dict.fromkeys(("learning_starts", "sde_sample_freq"), NonNegative),
}
"""Of those whose default does not tell."""
_FALLS: Final = "a number, or linear_<number> for one that falls to 0 over total_steps, such as linear_3e-4"
_LINEAR_NUMBER: Final = Annotated[str, matching(LINEAR + r"(\d+\.?\d*|\.\d+)([eE][-+]?\d{1,2})?", _FALLS)]


ALGORITHMS: Final = tuple(_MODULES)
"""Names, Stable-Baselines3's, sb3-contrib's and sbx's."""


def algorithm_class(name: str) -> type[BaseAlgorithm]:
    """The class of one of `ALGORITHMS`.

    Raises:
        ConfigurationError: It is one of a package that is not installed.
    """
    package = _MODULES[name]
    if package == "sbx":  # as torch, whatever else there is; JAX reads it at its first import
        os.environ.setdefault("JAX_PLATFORMS", "cpu")
    try:
        found: type[BaseAlgorithm] = getattr(importlib.import_module(package), name.removeprefix(SBX))
    except ModuleNotFoundError as missing:
        if missing.name not in _EXTRAS:
            raise
        raise ConfigurationError(
            f"algorithm: {name} is one of {package}'s, which is not installed: pip install"
            f" 'safe-wrappers[{_EXTRAS[package]}]'"
        ) from None
    return found


def check_hyperparameters(algorithm: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the hyperparameters with the types that the algorithm's constructor takes.

    Raises:
        ConfigurationError: Unknown names, values of the wrong type or outside their range.
    """
    signature = inspect.signature(algorithm_class(algorithm))
    parameters = {k: v for k, v in signature.parameters.items() if k not in _NOT_HYPERPARAMETERS}
    checked = {}
    for key, value in given.items():
        check_name(key, parameters, f"hyperparameters of {algorithm}")
        kind = _TYPES.get(key, _OF_DEFAULT.get(type(parameters[key].default), Any))
        falls = key in SCHEDULED and isinstance(value, str)
        checked[key] = validate(_LINEAR_NUMBER if falls else kind, value, f"hyperparameters.{key}")
    return checked


def default_of(algorithm: str, argument: str) -> Any:
    """The default of an argument of the algorithm's constructor."""
    return inspect.signature(algorithm_class(algorithm)).parameters[argument].default
