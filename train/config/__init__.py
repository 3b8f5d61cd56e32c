"""An experiment's settings: a YAML file and overrides, checked and turned into frozen dataclasses."""

from .load import parse_experiment, read_config

__all__ = ["parse_experiment", "read_config"]
