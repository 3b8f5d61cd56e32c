"""How long one action is held."""

from typing import Any

import gymnasium as gym

from safe_wrappers.constraints.constraint import positive
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.plant import check_timing


def control_interval(env: gym.Env[Any, Any], hold_s: float | None) -> float:
    """The control interval in s: the env's `dt`, or what was given if the env has none.

    Raises:
        ConfigurationError: Neither is there, or they disagree.
    """
    if hold_s is not None:
        hold_s = positive("hold_s", hold_s, "s")
        check_timing(env, hold_s, 0.0)
        return hold_s
    try:
        return positive("the env's dt", env.get_wrapper_attr("dt"), "s")
    except AttributeError:
        raise ConfigurationError(
            f"{env.unwrapped!r} does not say how long a step lasts (no attribute dt): pass hold_s, in seconds"
        ) from None
