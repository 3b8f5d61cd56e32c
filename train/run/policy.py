"""A trained policy as it acts outside training: deterministic, with frozen observation scaling."""

from __future__ import annotations

from typing import Any, Literal, Protocol

import gymnasium as gym
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from ..config import ArmConfig, FilterConfig
from ..config.algorithms import MASKED
from .stack import make_stack


class SavedPolicy(Protocol):
    """Where a policy is loaded from: a checkpoint, or a policy's folder."""

    def load_model(self, algorithm: str, env: None, device: str) -> BaseAlgorithm:
        """The model, to act only."""

    def load_normalize(self, env: VecEnv) -> VecEnv:
        """The running statistics around an env; the env itself if the run had none."""


class SpacesEnv(gym.Env[Any, Any]):
    """An env that has spaces and nothing else: what SB3 wants to be told of them by."""

    def __init__(self, observation_space: gym.Space[Any], action_space: gym.Space[Any]) -> None:
        self.observation_space = observation_space
        self.action_space = action_space


class TrainedPolicy:
    """The policy of a checkpoint, with the observation scaling and the action repeat that it was trained with.

    Args:
        arm: The arm that was trained.
        saved: Its policy.

    Attributes:
        arm: The arm.
        model: As SB3 loads it.
        deterministic: False: actions are drawn as in training, from torch's generator.
    """

    deterministic: bool = True

    def __init__(self, arm: ArmConfig, saved: SavedPolicy) -> None:
        self.arm = arm
        self.model = saved.load_model(arm.algorithm, None, arm.device)
        spaces = SpacesEnv(self.model.observation_space, self.model.action_space)
        scaled = saved.load_normalize(DummyVecEnv([lambda: spaces]))
        self._normalize = scaled if isinstance(scaled, VecNormalize) else None
        self._repeat = arm.action_repeat
        self.begin()

    def make_env(
        self, action_filter: Literal["trained", "none", "protect"] = "trained", render_mode: str | None = None
    ) -> gym.Env[Any, Any]:
        """The env that the policy was trained in, without what only training has (penalties, options of resets).

        Args:
            action_filter: The arm's own filter, or none, or `protect`'s.
            render_mode: As `gymnasium.make` takes it.
        """
        used = {"trained": self.arm.filter, "none": FilterConfig(), "protect": FilterConfig(protect={})}
        return make_stack(self.arm.env, used[action_filter], self.arm.learner.in_evaluation, render_mode)

    def begin(self, env: gym.Env[Any, Any] | None = None) -> None:
        """Start an episode: its first action is the policy's, and a policy's memory is empty.

        Args:
            env: Asked for action masks by MaskablePPO's policies; without one, all actions are free.
        """
        self._held, self._left = None, 0
        self._memory: Any = None
        self._masks = None
        if env is not None and self.arm.algorithm in MASKED and env.has_wrapper_attr("action_masks"):
            self._masks = env.get_wrapper_attr("action_masks")

    def __call__(self, observation: Any) -> Any:
        """The action of a control step, for an observation as the env gives it."""
        if self._left == 0:
            self._held, self._left = self._decide(observation), self._repeat
        self._left -= 1
        return self._held

    def _decide(self, observation: Any) -> Any:
        if self._normalize is not None:
            observation = self._normalize.normalize_obs(observation)
        masks = {} if self._masks is None else {"action_masks": self._masks()}
        action, self._memory = self.model.predict(
            observation,
            state=self._memory,
            episode_start=np.array([self._memory is None]),
            deterministic=self.deterministic,
            **masks,
        )
        return action
