"""`safe-wrappers sweep`: hyperparameters and filter parameters by Optuna, for the most return at cost zero."""

from .command import sweep_experiment

__all__ = ["sweep_experiment"]
