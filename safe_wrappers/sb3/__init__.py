"""Stable-Baselines3 glue: what the filter did, in the training's own log. The only room that imports SB3."""

from safe_wrappers.sb3.intervention_callback import InterventionCallback
from safe_wrappers.sb3.intervention_eval_callback import InterventionEvalCallback

__all__ = ["InterventionCallback", "InterventionEvalCallback"]
