"""An arm's curriculum of margins: the callback, and whether the arm's filter can have them."""

from __future__ import annotations

from typing import Any

import gymnasium as gym

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.sb3 import MarginCurriculum

from ..config import ArmConfig


def margin_curriculum(arm: ArmConfig) -> list[MarginCurriculum]:
    """The callback that changes the filter's margin, if the arm wants one."""
    given = arm.learner.margin_curriculum
    return [] if given is None else [MarginCurriculum(given.start, given.end, given.until)]


def check_margins(arm: ArmConfig, env: gym.Env[Any, Any]) -> None:
    """Refuses a margin that the arm's filter, around this env, cannot have.

    Raises:
        ConfigurationError: The filter has no margin, or it would leave nothing of some limit.
    """
    given = arm.learner.margin_curriculum
    if given is None:
        return
    where = f"arms.{arm.name}.learner.margin_curriculum"
    if not env.has_wrapper_attr("set_margin"):
        raise ConfigurationError(
            f"{where}: the filter has no set_margin; a CBFActionFilter has, and protect's."
        )
    try:
        env.get_wrapper_attr("set_margin")(max(given.start, given.end))
    except ConfigurationError as error:
        raise ConfigurationError(f"{where}: {error}") from None
