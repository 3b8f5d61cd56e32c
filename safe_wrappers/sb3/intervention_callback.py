"""Logs what the filter did during SB3's rollouts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from safe_wrappers import info as keys

_STEP_KEYS = {
    keys.CBF_INTERVENED: "step_rate",
    keys.CBF_INFEASIBLE: "step_infeasible",
    keys.CBF_FALLBACK: "step_fallback",
    keys.CBF_CORRECTION: "step_correction",
    keys.COST: "step_cost",
    keys.COST_SUBSTEP: "step_cost_substep",
    keys.ADAPTION_PENALTY: "step_penalty",
    keys.LEASE_EXPIRED: "step_lease_expired",
    keys.LEASE_REFUSED: "step_lease_refused",
    keys.LEASE_BRAKING: "step_lease_braking",
    keys.HANDOVER_PEAK_JERK: "step_peak_jerk",
    keys.HANDOVER_BLEND_TIME: "step_blend_time",
    keys.HANDOVER_STARVED: "step_starved",
    keys.HANDOVER_LIMITED: "step_limited",
    keys.FAULT_ACTIVE: "step_fault",
    keys.SPIN_OUT: "step_spin_out",
    keys.CONTACT_PEAK_FORCE: "step_contact_force",
    keys.OCCLUSION_PENALTY: "step_occlusion_penalty",
}
_LARGEST = {
    keys.SLIP_RATIO: "step_slip",
    keys.SLIP_LIMITED: "step_slip_limited",
    keys.OCCLUSION_SIGMA: "step_sigma",
}
"""Of several wheels or tracks."""
_SHARES = {keys.OCCLUSION_VISIBLE: "step_seen", keys.OCCLUSION_EXPIRED: "step_expired"}
"""Of the tracks."""


class InterventionCallback(BaseCallback):
    """Logs interventions, corrections and costs of the training rollouts under `interventions/`.

    Two kinds of values reach the logger (stdout, TensorBoard, CSV), both as means since its last dump:

    - `interventions/step_rate`, `step_infeasible`, `step_fallback`, `step_correction`, `step_cost`,
      `step_cost_substep`, `step_penalty` (AdaptionPenalty's), `step_lease_expired`, `step_lease_refused`,
      `step_lease_braking` (LeaseExpiry's), `step_peak_jerk`, `step_blend_time`, `step_starved`, `step_limited`
      (ChunkHandover's, per chunk), `step_fault`, `step_slip` (the largest size of any wheel), `step_slip_limited`
      (any wheel), `step_spin_out`, `step_contact_force` (ContactMonitor's, N), `step_seen` and `step_expired` (shares
      of the tracks), `step_sigma` (the largest of any track, m) and `step_occlusion_penalty` (OcclusionPenalty's):
      over all steps of all envs, from the keys that the wrappers and the task write at every step;
    - `interventions/rate`, `correction_mean`, `correction_p95`, `infeasible`, `fallback`, `nonfinite`,
      `unsafe`, `lease_expired`, `lease_refused`, `lease_braking`, `margin_min`, `violations`, `cost`,
      `cost_substep`, `goals_reached`, `spin_outs`, `success`, `collisions`, `seen`, `expiries`: over the episodes
      that ended, from `RecordInterventions`.

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
            log_episode(self.logger, info, "interventions/")
        return True


def log_steps(logger: Logger, infos: Iterable[Mapping[str, Any]]) -> None:
    """Adds one step of every env to the logger's running means."""
    for info in infos:
        for key, name in _STEP_KEYS.items():
            if key in info:
                logger.record_mean(f"interventions/{name}", float(info[key]))
        for key, name in _LARGEST.items():
            if key in info:
                logger.record_mean(f"interventions/{name}", float(np.abs(info[key]).max()))
        for key, name in _SHARES.items():
            if key in info:
                logger.record_mean(f"interventions/{name}", float(np.mean(info[key])))


def log_episode(logger: Logger, info: Mapping[str, Any], prefix: str) -> None:
    """Adds an episode's summary, if this info has one, to the logger's running means."""
    for key, value in info.get(keys.EPISODE_SUMMARY, {}).items():
        # SB3 already logs length and return of an episode as rollout/ep_len_mean and ep_rew_mean.
        if key not in ("length", "return"):
            logger.record_mean(prefix + ("rate" if key == "intervention_rate" else key), float(value))
