"""Which algorithms a config can name. Each is imported when it is used: torch takes seconds."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Final

from safe_wrappers.errors import ConfigurationError

from .names import check_name

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

_CONTRIB: Final = "sb3_contrib"
_MODULES: Final = {
    **dict.fromkeys(("PPO", "A2C", "SAC", "TD3", "DDPG", "DQN"), "stable_baselines3"),
    **dict.fromkeys(("TQC", "CrossQ", "TRPO", "QRDQN", "RecurrentPPO", "MaskablePPO"), _CONTRIB),
}
ON_POLICY: Final = ("PPO", "A2C", "TRPO", "RecurrentPPO", "MaskablePPO")
"""They learn from what they have just done, continuous actions or discrete ones."""
OFF_POLICY: Final = ("SAC", "TD3", "DDPG", "TQC", "CrossQ")
"""They learn from a replay buffer, continuous actions."""
DISCRETE: Final = ("DQN", "QRDQN")
"""They learn from a replay buffer, discrete actions; their filter is an ActionShield."""
MASKED: Final = ("MaskablePPO",)
"""Discrete actions; at every step they ask the env which of them are allowed (`action_masks`)."""
RECURRENT: Final = ("RecurrentPPO",)
"""Their policies have a memory, which is carried from step to step of an episode."""
DETERMINISTIC: Final = ("TD3", "DDPG")
"""Of `OFF_POLICY` those whose policy tries nothing out by itself."""

_NOT_OFFERED: Final = {
    "ARS": "it shows no steps to callbacks, and the episodes and interventions of a run are counted there",
}
"""Algorithms of sb3-contrib that do not work with the rest of a run, and why."""


class _Algorithms(Mapping[str, "type[BaseAlgorithm]"]):
    """Name -> class."""

    def __getitem__(self, name: str) -> type[BaseAlgorithm]:
        module = _MODULES[name]
        try:
            algorithm: type[BaseAlgorithm] = getattr(importlib.import_module(module), name)
        except ModuleNotFoundError as missing:
            if missing.name != _CONTRIB:
                raise
            raise ConfigurationError(
                f"algorithm: {name} is one of sb3-contrib's, which is not installed: pip install"
                " 'sb3-contrib>=2.6,<3' (the extra `contrib` of safe-wrappers)."
            ) from None
        return algorithm

    def __iter__(self) -> Iterator[str]:
        return iter(_MODULES)

    def __len__(self) -> int:
        return len(_MODULES)


ALGORITHMS: Final[Mapping[str, type[BaseAlgorithm]]] = _Algorithms()
"""Name -> class, Stable-Baselines3's and sb3-contrib's. `ConfigurationError` where the package is missing."""


def check_algorithm(name: str) -> str:
    """Returns the name if a config may use it.

    Raises:
        ConfigurationError: It exists, but does not work with the rest of a run.
        UnknownNameError: It does not exist.
    """
    if name in _NOT_OFFERED:
        raise ConfigurationError(
            f"{name} is not offered: {_NOT_OFFERED[name]}. Valid names: {', '.join(sorted(ALGORITHMS))}."
        )
    return check_name(name, ALGORITHMS)
