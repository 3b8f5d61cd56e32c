"""critic_value: an off-policy learner's critic as a function of an observation and actions."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm

from safe_wrappers.errors import ConfigurationError


def critic_value(model: BaseAlgorithm) -> Callable[[Any, NDArray[Any]], NDArray[np.float64]]:
    """What the critic of SAC, TD3, DDPG, TQC or DQN expects: for `StuckEscape(value=)`, `PredictiveShield(value=)`.

    The smallest of its networks' answers (of TQC the mean over quantiles of each), as the actor's own loss has it.

    Args:
        model: Its observations are those that the function is given; behind a VecNormalize they are scaled likewise.

    Returns:
        A function of one observation and actions, shape (k, m), in the env's units, that returns shape (k,).

    Raises:
        ConfigurationError: An algorithm whose critic does not judge actions, such as PPO.
    """
    critic: Any = getattr(model, "critic", None)
    q_net: Any = getattr(model, "q_net", None)
    if critic is None and q_net is None:
        raise ConfigurationError(
            f"critic_value needs a critic that judges actions: SAC, TD3, DDPG, TQC or DQN; {type(model).__name__} has"
            " none"
        )
    scaling, policy = model.get_vec_normalize_env(), model.policy
    start = int(getattr(model.action_space, "start", 0))

    def value(observation: Any, actions: NDArray[Any]) -> NDArray[np.float64]:
        if scaling is not None:
            observation = scaling.normalize_obs(observation)
        one, _ = policy.obs_to_tensor(observation)
        if q_net is not None:
            with torch.no_grad():
                of_each = q_net(one)[0].double().cpu().numpy()
            chosen: NDArray[np.float64] = of_each[np.asarray(actions)[:, 0].astype(int) - start]
            return chosen
        given: Any
        if isinstance(one, dict):
            given = {key: part.expand(len(actions), *part.shape[1:]) for key, part in one.items()}
        else:
            given = one.expand(len(actions), *one.shape[1:])
        scaled = torch.as_tensor(policy.scale_action(actions), dtype=torch.float32, device=policy.device)
        with torch.no_grad():
            answers = critic(given, scaled)
        # A column per network; TQC's answers have shape (k, networks, quantiles).
        answers = torch.cat(answers, dim=1) if isinstance(answers, tuple) else answers.mean(dim=2)
        lowest: NDArray[np.float64] = answers.min(dim=1).values.double().cpu().numpy()
        return lowest

    return value
