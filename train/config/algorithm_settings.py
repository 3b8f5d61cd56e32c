"""The hyperparameters of a config: texts and numbers, by the names of the algorithms' constructors."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, Field, StrictBool

from safe_wrappers.errors import ConfigurationError

from .algorithms import ALGORITHMS
from .names import check_name
from .types import Count, Integer, NonNegative, Number, matching, validate

# What the run itself decides; the rest of the constructor's arguments are hyperparameters.
_NOT_HYPERPARAMETERS: Final = {"self", "env", "seed", "device", "verbose", "tensorboard_log"} | {
    "_init_setup_model",
    "stats_window_size",
}
SCHEDULED: Final = ("learning_rate", "clip_range", "clip_range_vf")
"""What may fall in the course of a run: a number, or a text such as `linear_3e-4`."""
LINEAR: Final = "linear_"
HER: Final = "HerReplayBuffer"


def _action_noise(value: Any) -> Any:
    if value is None or value == "none":
        return value
    if isinstance(value, Mapping) and len(value) == 1:
        ((kind, size),) = value.items()
        check_name(kind, ("normal", "ornstein_uhlenbeck"))
        if isinstance(size, int | float) and not isinstance(size, bool) and 0.0 < size < math.inf:
            return value
    raise ConfigurationError(
        "expected none, {normal: 0.1} or {ornstein_uhlenbeck: 0.1}, a standard deviation above 0 of"
        f" actions scaled to [-1, 1]; got {value!r}."
    )


_OF_DEFAULT: Final[Mapping[type, Any]] = {bool: StrictBool, int: Integer, float: Number}
_TYPES: Final[Mapping[str, Any]] = {
    "learning_rate": Annotated[Number, Field(gt=0)],
    "action_noise": Annotated[Any, AfterValidator(_action_noise)],
    "replay_buffer_class": Literal["HerReplayBuffer"],
    "train_freq": Any,  # may be [4, "episode"]
    **dict.fromkeys(("n_steps", "batch_size", "n_epochs", "buffer_size"), Count),
    **dict.fromkeys(("learning_starts", "sde_sample_freq"), NonNegative),
}
"""Of those whose default does not tell."""
_LINEAR_NUMBER: Final = Annotated[
    str,
    matching(
        LINEAR + r"(?=[0.]*[1-9])(\d+\.?\d*|\.\d+)([eE][-+]?\d{1,2})?",
        "a number, or linear_<number> for one that falls to 0 over total_steps, such as linear_3e-4",
    ),
]
_HER_OPTIONS: Final[Mapping[str, Any]] = {
    "n_sampled_goal": NonNegative,
    "goal_selection_strategy": Literal["future", "final", "episode"],
    "copy_info_dict": StrictBool,
    "handle_timeout_termination": StrictBool,
}


def check_hyperparameters(algorithm: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the hyperparameters with the types that the algorithm's constructor takes.

    Raises:
        ConfigurationError: Unknown names, values of the wrong type or outside their range.
    """
    signature = inspect.signature(ALGORITHMS[algorithm])
    parameters = {k: v for k, v in signature.parameters.items() if k not in _NOT_HYPERPARAMETERS}
    checked = {}
    for key, value in given.items():
        check_name(key, parameters, f"hyperparameters of {algorithm}")
        kind = _TYPES.get(key, _OF_DEFAULT.get(type(parameters[key].default), Any))
        falls = key in SCHEDULED and isinstance(value, str)
        checked[key] = validate(_LINEAR_NUMBER if falls else kind, value, f"hyperparameters.{key}")
    if checked.get("replay_buffer_class") == HER:
        where = "hyperparameters.replay_buffer_kwargs"
        for key, value in validate(dict[str, Any], checked.get("replay_buffer_kwargs") or {}, where).items():
            validate(_HER_OPTIONS[check_name(key, _HER_OPTIONS, where)], value, f"{where}.{key}")
    return checked
