"""AdaptionPenalty: the learner's reward is reduced where the filter changed its action."""

import math
from typing import Any, ClassVar

import numpy as np

from safe_wrappers import info as keys
from safe_wrappers.checks import non_negative, positive
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.env_checks import one_reward, refuse_vector_rewards
from safe_wrappers.stack import Layer
from safe_wrappers.wrappers.cbf_action_filter import filter_inside
from safe_wrappers.wrappers.common.layer import Env, LayerWrapper, Reset, Step


class AdaptionPenalty(LayerWrapper):
    """Takes a penalty off the reward at every step at which the filter changed the action, or an escape replaced it.

    The learner keeps its own action a, and its reward is r(s, a_safe) less a function of the correction
    c = |a_safe - a| (Krasowski et al., Provably Safe Reinforcement Learning, TMLR 2023), the sum of

    - `penalty`,
    - `per_correction * c`,
    - `per_squared * c^2`,
    - `bounded * (1 - exp(-c^2 / scale^2))`, which never costs more than `bounded` (the reward of Yang et al., CBF-RL,
      2025, as a penalty).

    Wrappers that scale or clip rewards belong inside, and `RecordInterventions` and SB3's `Monitor` too. With
    hindsight replay use `safe_wrappers.sb3.ExecutedActionHerReplayBuffer`, which takes the penalty off relabelled
    rewards too.

    Args:
        env: With a `CBFActionFilter` inside.
        penalty: For every changed step, in units of the task's reward, at least 0.
        per_correction: For each unit of `cbf/correction` (L2 norm, action units) of a changed step, at least 0.
        per_squared: For each unit of its square, at least 0.
        bounded: What a large correction costs, in units of the task's reward, at least 0.
        scale: Of `bounded`: a correction of this size, in action units, costs 63 % of it. Above 0.

    Info, at every step: ``adaption/penalty`` and ``adaption/task_reward`` (float), whose difference is the reward.

    Raises:
        ConfigurationError: No filter inside, a second AdaptionPenalty, no penalty, one that is negative, or a `scale`
            without `bounded`.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> env = sw.CBFActionFilter(gym.make("Reacher-v5"), [sw.constraints.JointSpeedLimit(limit=4.0)])
        >>> env = sw.AdaptionPenalty(env, penalty=0.1)
        >>> _ = env.reset(seed=0)
        >>> _, reward, _, _, info = env.step(env.action_space.sample())
        >>> float(reward) == info["adaption/task_reward"] - info["adaption/penalty"]
        True
    """

    layer: ClassVar = Layer.ADAPTION

    def __init__(
        self,
        env: Env,
        penalty: float = 0.0,
        per_correction: float = 0.0,
        per_squared: float = 0.0,
        bounded: float = 0.0,
        scale: float = 1.0,
    ) -> None:
        LayerWrapper.__init__(self, env)
        refuse_vector_rewards(env, "AdaptionPenalty")
        if filter_inside(env) is None:
            example = "AdaptionPenalty(sw.protect(env), penalty=...)"
            raise ConfigurationError(f"AdaptionPenalty needs a CBFActionFilter inside: {example}")
        self.penalty = non_negative("penalty", penalty, "the task's reward")
        self.per_correction = non_negative("per_correction", per_correction, "reward per action unit")
        self.per_squared = non_negative("per_squared", per_squared, "reward per squared action unit")
        self.bounded = non_negative("bounded", bounded, "the task's reward")
        self.scale = positive("scale", scale, "action units")
        if not (self.penalty or self.per_correction or self.per_squared or self.bounded):
            raise ConfigurationError(
                "AdaptionPenalty: give penalty (per step), per_correction (per unit of cbf/correction), per_squared"
                " (per squared unit), bounded (the most that a correction may cost), or several of them"
            )
        if self.scale != 1.0 and not self.bounded:
            raise ConfigurationError(
                f"scale = {self.scale:g} says at what correction `bounded` bends: give bounded, or no scale"
            )
        names = ("penalty", "per_correction", "per_squared", "bounded", "scale")
        self._record({name: getattr(self, name) for name in names})

    def of(self, correction: float) -> float:
        """The penalty of a changed step, in units of the task's reward, for a correction in action units."""
        share = correction / self.scale
        return (
            self.penalty
            + self.per_correction * correction
            + self.per_squared * correction * correction
            - self.bounded * math.expm1(-share * share)
        )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Reset:
        """Resets the env; its info holds the keys of a step, as 0."""
        observation, info = self.env.reset(seed=seed, options=options)
        info[keys.ADAPTION_PENALTY] = info[keys.ADAPTION_TASK_REWARD] = 0.0
        return observation, info

    def step(self, action: Any) -> Step:
        """Steps the env; an unchanged step's reward passes through untouched."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        penalty = 0.0
        info[keys.ADAPTION_TASK_REWARD] = one_reward(reward, "AdaptionPenalty")
        changed, correction = info[keys.CBF_INTERVENED], info[keys.CBF_CORRECTION]
        if info.get(keys.CBF_ESCAPING, False):  # StuckEscape gave the filter another action than this one
            changed, correction = True, np.linalg.norm(info[keys.EXECUTED_ACTION] - np.nan_to_num(action))
        if changed:
            penalty = self.of(float(correction))
            reward = float(reward) - penalty
        info[keys.ADAPTION_PENALTY] = penalty
        return observation, reward, terminated, truncated, info
