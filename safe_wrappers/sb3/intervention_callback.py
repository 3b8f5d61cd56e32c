"""Logs what the filter did during SB3's rollouts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from safe_wrappers import info as keys


class InterventionCallback(BaseCallback):
    """Logs interventions, corrections and costs of the training rollouts under `interventions/`.

    Two kinds of values reach the logger (stdout, TensorBoard, CSV), both as means since its last dump:

    - `interventions/step_<name>`: over all steps of all envs, from the keys that the wrappers and the task write at
      every step; `InfoKey.log` in `safe_wrappers.info` is the name of each, such as `step_rate`, `step_cost`,
      `step_lease_braking` or `step_sigma`;
    - `interventions/rate`, `correction_mean`, `infeasible`, `violations` and the other figures of
      `safe_wrappers.info.EPISODE`: over the episodes that ended, from `RecordInterventions`.

    What neither the task nor a layer of the stack reports is not logged: no filter, no `rate`; no cost, no
    `violations`.

    It reads infos only, so it works the same with `DummyVecEnv` and `SubprocVecEnv`. For evaluation use
    `InterventionEvalCallback`.

    Example:
        >>> import gymnasium as gym
        >>> from stable_baselines3 import PPO
        >>> from safe_wrappers.sb3 import InterventionCallback
        >>> from safe_wrappers.wrappers.record_interventions import RecordInterventions
        >>> env = RecordInterventions(gym.make("Pendulum-v1"))
        >>> model = PPO("MlpPolicy", env, n_steps=256, n_epochs=1, device="cpu")
        >>> _ = model.learn(256, callback=InterventionCallback())
    """

    def _on_step(self) -> bool:
        log_steps(self.logger, self.locals["infos"])
        for info in self.locals["infos"]:
            log_episode(self.logger, info, keys.RUNNING_PREFIX)
        return True


def log_steps(logger: Logger, infos: Iterable[Mapping[str, Any]]) -> None:
    """Adds one step of every env to the logger's running means."""
    for info in infos:
        for key in keys.KEYS.values():
            if key.log and key.name in info:
                logger.record_mean(f"{keys.RUNNING_PREFIX}step_{key.log}", key.number(info[key.name]))


def log_episode(logger: Logger, info: Mapping[str, Any], prefix: str) -> None:
    """Adds an episode's summary, if this info has one, to the logger's running means."""
    for key, value in info.get(keys.EPISODE_SUMMARY, {}).items():
        # SB3 already logs length and return of an episode as rollout/ep_len_mean and ep_rew_mean.
        if key not in ("length", "return"):
            logger.record_mean(prefix + ("rate" if key == "intervention_rate" else key), float(value))
