"""Callbacks that log what the filter did during SB3's rollouts and evaluations."""

from collections.abc import Iterable, Mapping
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.logger import Logger

from safe_wrappers import info as keys


class InterventionCallback(BaseCallback):
    """Logs interventions, corrections and costs of the training rollouts under `interventions/`.

    The logger gets means since its last dump, of what the task and the layers of the stack report:

    - `interventions/step_<name>`: over all steps of all envs; `InfoKey.log` in `safe_wrappers.info` is the name of
      each, such as `step_rate` or `step_cost`;
    - `interventions/rate`, `correction_mean` and the other figures of `safe_wrappers.info.EPISODE`: over the episodes
      that ended, from `RecordInterventions`.

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


class InterventionEvalCallback(EvalCallback):
    """Logs `RecordInterventions`' episode values under `eval/interventions/`, beside `eval/mean_reward`.

    Same arguments as SB3's `EvalCallback`, which dumps the log before any child callback runs.
    """

    def _log_success_callback(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        # SB3's hook into `evaluate_policy`, called at every step of every evaluation env, before the dump.
        super()._log_success_callback(locals_, globals_)
        if locals_["done"]:
            log_episode(self.logger, locals_["info"], "eval/interventions/")


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
