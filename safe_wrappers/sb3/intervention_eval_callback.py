"""SB3's EvalCallback that also logs what the filter did in its evaluation episodes."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.callbacks import EvalCallback

from safe_wrappers.sb3.intervention_callback import log_episode


class InterventionEvalCallback(EvalCallback):
    """Logs `RecordInterventions`' episode values under `eval/interventions/`, beside `eval/mean_reward`.

    Same arguments as SB3's `EvalCallback`. A plain callback cannot do this: `EvalCallback` dumps the log
    before any child callback runs, so the values would land at the next rollout's step, or not at all.
    """

    def _log_success_callback(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        # SB3's hook into `evaluate_policy`, called at every step of every evaluation env, before the dump.
        super()._log_success_callback(locals_, globals_)
        if locals_["done"]:
            log_episode(self.logger, locals_["info"], "eval/interventions/")
