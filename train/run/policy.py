"""A trained policy as it acts outside training: deterministic, with frozen observation scaling."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from ..config import ArmConfig, FilterConfig
from .checkpoint import Checkpoint
from .stack import make_stack


class TrainedPolicy:
    """The policy of a checkpoint, with the observation scaling and the action repeat that it was trained with.

    Args:
        arm: The arm that was trained.
        checkpoint: Its policy.

    Attributes:
        model: As SB3 loads it.
        deterministic: False: actions are drawn as in training, from torch's generator.
    """

    deterministic: bool = True

    def __init__(self, arm: ArmConfig, checkpoint: Checkpoint) -> None:
        self.model: BaseAlgorithm = checkpoint.load_model(arm.algorithm, None, arm.device)
        scaled = checkpoint.load_normalize(DummyVecEnv([lambda: make_stack(arm.env, FilterConfig())]))
        self._normalize = scaled if isinstance(scaled, VecNormalize) else None
        scaled.close()
        self._repeat = arm.action_repeat
        self.begin()

    def begin(self) -> None:
        """Start an episode: its first action is the policy's."""
        self._held, self._left = None, 0

    def __call__(self, observation: Any) -> Any:
        """The action of a control step, for an observation as the env gives it."""
        if self._left == 0:
            self._held, self._left = self._decide(observation), self._repeat
        self._left -= 1
        return self._held

    def _decide(self, observation: Any) -> Any:
        if self._normalize is not None:
            observation = self._normalize.normalize_obs(observation)
        return self.model.predict(observation, deterministic=self.deterministic)[0]
