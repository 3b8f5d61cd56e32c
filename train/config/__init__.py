"""An experiment's settings: a YAML file and overrides, checked and turned into frozen dataclasses."""

from .load import parse_experiment, read_config, set_value
from .models import (
    NAIVE,
    ArmConfig,
    EnvConfig,
    EvaluationConfig,
    ExperimentConfig,
    FilterConfig,
    LearnerConfig,
    SweepConfig,
    check_env_id,
    stored_arm,
)

__all__ = [
    "NAIVE",
    "ArmConfig",
    "EnvConfig",
    "EvaluationConfig",
    "ExperimentConfig",
    "FilterConfig",
    "LearnerConfig",
    "SweepConfig",
    "check_env_id",
    "parse_experiment",
    "read_config",
    "set_value",
    "stored_arm",
]
