"""log_probability: an on-policy learner's policy as a function of an observation and actions."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm

from safe_wrappers.errors import ConfigurationError


def log_probability(model: BaseAlgorithm) -> Callable[[Any, NDArray[Any]], NDArray[np.float64]]:
    """How probable an on-policy learner's policy makes actions: for `PredictiveShield(value=)`.

    Args:
        model: PPO, A2C, TRPO or MaskablePPO; else as in `critic_value`.

    Returns:
        A function of one observation and actions, shape (k, m), that returns logarithms, shape (k,).

    Raises:
        ConfigurationError: A policy that gives no probabilities, such as SAC's.
    """
    policy: Any = model.policy
    if not hasattr(policy, "evaluate_actions"):
        raise ConfigurationError(
            f"log_probability needs a policy that gives probabilities: PPO, A2C, TRPO or MaskablePPO; "
            f"{type(model).__name__} gives none; critic_value says what its critic prefers"
        )
    scaling = model.get_vec_normalize_env()

    def value(observation: Any, actions: NDArray[Any]) -> NDArray[np.float64]:
        if scaling is not None:
            observation = scaling.normalize_obs(observation)
        one, _ = policy.obs_to_tensor(observation)
        given = torch.as_tensor(np.asarray(actions), dtype=torch.float32, device=policy.device)
        if isinstance(model.action_space, gym.spaces.Discrete):
            given = given[:, 0]
        with torch.no_grad():
            logs: NDArray[np.float64] = policy.get_distribution(one).log_prob(given).double().cpu().numpy()
        return logs

    return value
