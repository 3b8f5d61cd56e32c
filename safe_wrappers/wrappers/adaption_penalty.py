"""AdaptionPenalty: the learner's reward is reduced where the filter changed its action."""

from typing import Any, ClassVar

from safe_wrappers import info as keys
from safe_wrappers.checks import non_negative
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.stack import Layer
from safe_wrappers.wrappers.cbf_action_filter import is_filtered
from safe_wrappers.wrappers.common.layer import Env, LayerWrapper, Reset, Step


class AdaptionPenalty(LayerWrapper):
    """Takes a penalty off the reward at every step at which the filter changed the action.

    The learner keeps its own action a, and its reward is r(s, a_safe) less `penalty + per_correction * |a_safe - a|`
    (Krasowski et al., Provably Safe Reinforcement Learning, TMLR 2023). Wrappers that scale or clip rewards belong
    inside, and `RecordInterventions` and SB3's `Monitor` too. With hindsight replay use
    `safe_wrappers.sb3.ExecutedActionHerReplayBuffer`, which takes the penalty off relabelled rewards too.

    Args:
        env: With a `CBFActionFilter` inside.
        penalty: For every changed step, in units of the task's reward, at least 0.
        per_correction: For each unit of `cbf/correction` (L2 norm, action units) of a changed step, at least 0.

    Info, at every step: ``adaption/penalty`` and ``adaption/task_reward`` (float), whose difference is the reward.

    Raises:
        ConfigurationError: No filter inside, a second AdaptionPenalty, or no penalty, or one that is negative.

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

    def __init__(self, env: Env, penalty: float = 0.0, per_correction: float = 0.0) -> None:
        LayerWrapper.__init__(self, env)
        if not is_filtered(env):
            example = "AdaptionPenalty(sw.protect(env), penalty=...)"
            raise ConfigurationError(f"AdaptionPenalty needs a CBFActionFilter inside: {example}")
        penalty = non_negative("penalty", penalty, "the task's reward")
        per_correction = non_negative("per_correction", per_correction, "reward per action unit")
        if penalty == 0.0 and per_correction == 0.0:
            raise ConfigurationError(
                "AdaptionPenalty: give penalty (per step), per_correction (per unit of cbf/correction), or both"
            )
        self._record({"penalty": penalty, "per_correction": per_correction})
        self.penalty, self.per_correction = penalty, per_correction

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Reset:
        """Resets the env; its info holds the keys of a step, as 0."""
        observation, info = self.env.reset(seed=seed, options=options)
        info[keys.ADAPTION_PENALTY] = info[keys.ADAPTION_TASK_REWARD] = 0.0
        return observation, info

    def step(self, action: Any) -> Step:
        """Steps the env; an unchanged step's reward passes through untouched."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        penalty = 0.0
        info[keys.ADAPTION_TASK_REWARD] = float(reward)
        if info[keys.CBF_INTERVENED]:
            penalty = self.penalty + self.per_correction * float(info[keys.CBF_CORRECTION])
            reward = float(reward) - penalty
        info[keys.ADAPTION_PENALTY] = penalty
        return observation, reward, terminated, truncated, info
