"""ConstraintJudge: the filter's own limits as the judge of a task that reports no cost."""

from __future__ import annotations

from typing import Any, Final, SupportsFloat

import gymnasium as gym
import numpy as np

from safe_wrappers import info as keys
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.engine import SafetyFilter
from safe_wrappers.plants import MujocoPlant
from safe_wrappers.plants.default import default_plant
from safe_wrappers.wrappers.cost_function import refuse_own_cost

_TOLERANCE: Final = 1e-6
"""h below zero by less is rounding, in the constraints' own units; the filter's `cbf/unsafe` has the same."""


class ConstraintJudge(gym.Wrapper[Any, Any, Any, Any]):
    """Writes ``info["cost"]``: 1 where some constraint's h is negative at the end of the step, else 0.

    h is read from the env's true state, to the limit itself (a constraint's margin is not taken off): of a MuJoCo
    env through a plant of its own on the env's own model, whatever model and delay the filter has. So it judges in
    the same way whether the filter is on or not. It sees what the constraints speak of, and nothing else.

    Args:
        task: Reports no cost.
        judging: The filter around the same task, whose constraints are used; it is never stepped.

    Raises:
        ConfigurationError: It is no CBFActionFilter, one of them has no h (`value`), or the filter
            has a plant of the user's own with a delay, which does not see the present state.
    """

    def __init__(self, task: gym.Env[Any, Any], judging: gym.Env[Any, Any]) -> None:
        super().__init__(task)
        if not judging.has_wrapper_attr("filter"):
            raise ConfigurationError(
                "env.judge: the filter has no constraints and plant that could judge (a CBFActionFilter has); use "
                "env.cost: module:function"
            )
        its_filter: SafetyFilter = judging.get_wrapper_attr("filter")
        for constraint in its_filter.bound:
            if not constraint.has_value:
                raise ConfigurationError(
                    f"env.judge: {type(constraint.spec).__name__} has no h (`value`) and cannot judge; use env.cost: "
                    "module:function"
                )
        self._plant = its_filter.plant
        self._constraints = its_filter.bound
        if isinstance(self._plant, MujocoPlant):
            self._plant = default_plant(task)
            self._plant.bind(task)
            self._bind()
        elif self._plant.delay_s:
            raise ConfigurationError(
                f"env.judge: the filter's plant looks {self._plant.delay_s} s ahead and does not see the present "
                "state; use env.cost: module:function"
            )

    def _bind(self) -> None:
        self._model_version = self._plant.model_version
        self._constraints = [constraint.spec.bind(self._plant) for constraint in self._constraints]
        for constraint in self._constraints:
            constraint.start()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Resets the env; info has the cost of the state in which the episode starts."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._plant.executed(None)
        self._memories = [constraint.start() for constraint in self._constraints]
        self._judge(observation, info)
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Steps the env and judges where it is now."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._judge(observation, info)
        return observation, reward, terminated, truncated, info

    def _judge(self, observation: Any, info: dict[str, Any]) -> None:
        refuse_own_cost(self.unwrapped, info)
        self._plant.received(observation, info)
        self._plant.observe()
        if isinstance(self._plant, MujocoPlant) and self._plant.model_version != self._model_version:
            self._bind()
        cost, still = 0.0, np.zeros(self._plant.lower.size)
        for i, constraint in enumerate(self._constraints):
            constraint.observe(self._memories[i])
            # Negated, so that an h that is not a number is a violation.
            cost = max(cost, float(not (constraint.value() >= -_TOLERANCE).all()))
            self._memories[i] = constraint.executed(still)
        info[keys.COST] = cost
