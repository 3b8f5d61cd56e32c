"""What an arm's learner needs beside its algorithm: a margin that changes, a price on cost."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from stable_baselines3.common.callbacks import BaseCallback

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.sb3 import LagrangianMultiplier, MarginCurriculum

from ..config import ArmConfig


def learner_callbacks(arm: ArmConfig) -> list[BaseCallback]:
    """Those that `arm.learner` wants."""
    learner, found = arm.learner, list[BaseCallback]()
    if (margin := learner.margin_curriculum) is not None:
        found.append(MarginCurriculum(margin.start, margin.end, margin.until))
    if learner.cost_limit is not None:
        found.append(LagrangianMultiplier(learner.cost_limit, learner.multiplier_rate))
    return found


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
