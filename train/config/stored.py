"""From the settings in a run's folder back to its arm."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from safe_wrappers.errors import ConfigurationError

from .algorithms import ON_POLICY
from .models import ArmConfig, FilterConfig, default_buffer_size
from .types import validate


def stored_arm(name: str, fingerprint: Mapping[str, Any]) -> ArmConfig:
    """The arm whose `ArmConfig.fingerprint` this is.

    Args:
        name: The arm's.
        fingerprint: As JSON gave it back.

    Returns:
        The arm. What a fingerprint leaves out (`checkpoint_every`, `device`, `vec_env`) has its default.

    Raises:
        ConfigurationError: It is no fingerprint, or one of a later version.
    """
    if not isinstance(fingerprint, Mapping) or not isinstance(fingerprint.get("env"), Mapping):
        raise ConfigurationError(f"expected the settings of a run, got {fingerprint!r}.")
    settings = {**fingerprint, "name": name}
    if "filter" in settings:
        settings["filter"] = stored_filter(settings["filter"])
    of_filter = {key: stored_filter(env) for key, env in fingerprint["env"].items() if key in _FILTERS}
    settings["env"] = {**fingerprint["env"], **of_filter}
    hyperparameters = dict(settings.get("hyperparameters", {}))
    if settings.get("algorithm") not in ON_POLICY and "total_steps" in settings:
        hyperparameters.setdefault("buffer_size", default_buffer_size(settings["total_steps"]))
    settings["hyperparameters"] = hyperparameters
    arm: ArmConfig = validate(ArmConfig, settings, f"arms.{name}")
    return arm


_FILTERS = ("judge", "observation")


def stored_filter(plain: Mapping[str, Any]) -> FilterConfig:
    """The filter whose `FilterConfig.plain` this is."""
    settings = {key: plain[key] for key in ("lease", "escape") if plain.get(key) is not None}
    if plain["kind"] == "protect":
        settings["protect"] = plain["kwargs"]
    elif plain["kind"] == "factory":
        settings |= {"factory": plain["factory"], "kwargs": plain["kwargs"]}
    found: FilterConfig = validate(FilterConfig, settings, "filter")
    return found
