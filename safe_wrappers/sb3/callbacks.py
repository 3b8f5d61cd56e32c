"""Callbacks: what the filter did in the log, and a price on cost."""

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from safe_wrappers import info as keys
from safe_wrappers.errors import ConfigurationError, non_negative, positive


class InterventionCallback(BaseCallback):
    """Logs interventions, corrections and costs of the training rollouts under `interventions/`.

    The logger gets means since its last dump, of what the task and the layers of the stack report:

    - `interventions/step_<name>`: over all steps of all envs; `InfoKey.log` in `safe_wrappers.info` is the name of
      each, such as `rate` or `cost`, after `step_`;
    - `interventions/rate`, `correction_mean` and the other figures of `safe_wrappers.info.EPISODE`: over the episodes
      that ended, from `RecordInterventions`.

    Example:
        >>> import gymnasium as gym
        >>> from stable_baselines3 import PPO
        >>> from safe_wrappers.sb3 import InterventionCallback
        >>> from safe_wrappers.wrappers.recording import RecordInterventions
        >>> env = RecordInterventions(gym.make("Pendulum-v1"))
        >>> model = PPO("MlpPolicy", env, n_steps=256, n_epochs=1, device="cpu")
        >>> _ = model.learn(256, callback=InterventionCallback())
    """

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            for key in keys.KEYS.values():
                number = key.number(info[key.name]) if key.log and key.name in info else np.nan
                if not np.isnan(number):  # NaN is no report
                    self.logger.record_mean(f"interventions/step_{key.log}", number)
            for name, value in info.get(keys.EPISODE_SUMMARY, {}).items():
                # SB3 already logs length and return of an episode as rollout/ep_len_mean and ep_rew_mean.
                if name not in ("length", "return"):
                    short = name.removeprefix("intervention_")
                    self.logger.record_mean(f"interventions/{short}", float(value))
        return True


class LagrangianMultiplier(BaseCallback):
    """Makes a constrained learner of an SB3 algorithm: PPO with it is PPO-Lagrangian, SAC with it SAC-Lagrangian.

    The learner stores `(r - m c) / (1 + m)` instead of the reward r; c is the step's cost (``info["cost"]``), m >= 0
    the multiplier. After every episode, whose costs add up to C, `m <- max(0, m + rate (C - cost_limit))` (Ray,
    Achiam and Amodei, Benchmarking Safe Exploration in Deep RL, 2019, with one value function for both). The limit
    holds on average and at the end of training, if at all; a filter holds it at every step, from the first one on.
    With a limit of 0 the multiplier can only rise.

    Returns that SB3 logs stay the task's own. The multiplier is saved with the model, as `lagrangian_multiplier`, and
    goes on from there. An off-policy learner replays what was stored at the multiplier of that time. Behind a
    VecNormalize that scales rewards, m is in scaled reward per cost.

    Args:
        cost_limit: Cost per episode that is allowed, at least 0.
        rate: Of the multiplier, in reward per cost, for each unit of cost above the limit. Above 0.

    Raises:
        ConfigurationError: Numbers outside these ranges; in training: an env that reports no cost or one that is
            not finite, hindsight replay, or an off-policy learner behind a VecNormalize: they replay the env's own
            rewards.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> from stable_baselines3 import PPO
        >>> from safe_wrappers.sb3 import LagrangianMultiplier
        >>> model = PPO("MlpPolicy", gym.make("SafePointGoal1-v0"), n_steps=64, n_epochs=1, device="cpu")
        >>> _ = model.learn(128, callback=LagrangianMultiplier(cost_limit=25.0))
    """

    def __init__(self, cost_limit: float, rate: float = 1e-3) -> None:
        super().__init__()
        self.cost_limit = non_negative("cost_limit", cost_limit, "cost per episode")
        self.rate = positive("rate", rate, "reward per cost, for each unit of cost")

    @property
    def multiplier(self) -> float:
        """Reward per cost."""
        return float(getattr(self.model, "lagrangian_multiplier", 0.0))

    def _on_training_start(self) -> None:
        replays = getattr(self.model, "replay_buffer", None)
        scaled = replays is not None and self.model.get_vec_normalize_env() is not None
        if scaled or isinstance(replays, HerReplayBuffer):
            raise ConfigurationError(
                "LagrangianMultiplier: off-policy learners with hindsight replay or a VecNormalize learn from"
                " the env's own rewards, without a price on cost; leave that out, or use an on-policy learner"
            )
        self._episode_cost = np.zeros(self.training_env.num_envs)

    def _on_step(self) -> bool:
        infos = self.locals["infos"]
        if not all(keys.COST in info for info in infos):
            raise ConfigurationError(
                "LagrangianMultiplier needs info['cost'] at every step: the goal and velocity tasks have it, and"
                " sw.CostFunction(env, cost) gives it to any other"
            )
        costs = np.array([info[keys.COST] for info in infos], dtype=np.float64)
        if not np.isfinite(costs).all():
            raise ConfigurationError(f"info['cost'] must be finite, got {costs.tolist()}")
        multiplier = self.multiplier
        # SB3 stores this very array after its callbacks.
        rewards = self.locals["rewards"]
        rewards[:] = (rewards - multiplier * costs) / (1.0 + multiplier)
        self._episode_cost += costs
        for i in np.flatnonzero(self.locals["dones"]):
            multiplier = max(0.0, multiplier + self.rate * (self._episode_cost[i] - self.cost_limit))
            self._episode_cost[i] = 0.0
        self.model.lagrangian_multiplier = float(multiplier)  # type: ignore[attr-defined]
        self.logger.record("interventions/lagrangian_multiplier", multiplier)
        return True
