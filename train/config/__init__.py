"""An experiment's settings: a YAML file and overrides, checked and turned into frozen dataclasses."""

from .experiment import parse_experiment
from .file import read_config
from .learner import NAIVE, LearnerConfig
from .models import (
    ArmConfig,
    EnvConfig,
    EvaluationConfig,
    ExperimentConfig,
    FilterConfig,
    NormalizeConfig,
)
from .sweep import ParameterConfig, SweepConfig

__all__ = [
    "NAIVE",
    "ArmConfig",
    "EnvConfig",
    "EvaluationConfig",
    "ExperimentConfig",
    "FilterConfig",
    "LearnerConfig",
    "NormalizeConfig",
    "ParameterConfig",
    "SweepConfig",
    "parse_experiment",
    "read_config",
]
