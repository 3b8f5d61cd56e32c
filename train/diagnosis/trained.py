"""A policy to diagnose: a finished run's, or a model file of Stable-Baselines3."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.save_util import load_from_zip_file

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.wrappers.record_interventions import RecordInterventions

from ..config import ArmConfig, EnvConfig, FilterConfig
from ..config.algorithms import ALGORITHMS
from ..run.checkpoint import latest_checkpoint
from ..run.policy import TrainedPolicy
from ..run.stack import make_stack
from ..run.training import RUN_FILE

Policy = Callable[[Any], Any]


def of_run(folder: Path, env_id: str) -> tuple[gym.Env[Any, Any], Policy]:
    """The policy of a run's newest checkpoint, and its env without the filter.

    Raises:
        ConfigurationError: The folder holds no run, no checkpoint, or the policy of another env.
    """
    file = folder / RUN_FILE
    if not file.is_file():
        raise ConfigurationError(
            f"--policy: {str(folder)!r} is no run's folder (it has no {RUN_FILE}): give runs/NAME/ARM/seed_N, or a "
            "model.zip"
        )
    arm = _arm(json.loads(file.read_text())["config"])
    if arm.env.id != env_id:
        raise ConfigurationError(
            f"--policy: {str(folder)!r} was trained on {arm.env.id}, not on {env_id}: diagnose that env"
        )
    checkpoint = latest_checkpoint(folder / "checkpoints", print)
    if checkpoint is None:
        raise ConfigurationError(f"--policy: {str(folder)!r} has no checkpoint yet")
    env = make_stack(arm.env, FilterConfig())
    while isinstance(env, Monitor | RecordInterventions):  # they belong outside of filters that are tried
        env = env.env
    return env, TrainedPolicy(arm, checkpoint)


def _arm(config: dict[str, Any]) -> ArmConfig:
    """What a policy needs to act, from the settings in a run's file."""
    settings = {key: value for key, value in config["env"].items() if key not in ("observation", "judge")}
    seen = config["env"].get("observation") or {}
    if seen.get("kind", "none") != "none":
        by_name = {"protect": seen["kwargs"]} if seen["kind"] == "protect" else {}
        settings["observation"] = FilterConfig(
            **(by_name or {"factory": seen["factory"], "kwargs": seen["kwargs"]})
        )
    names = ("algorithm", "action_repeat", "total_steps")
    return ArmConfig(
        name="diagnosed",
        env=EnvConfig(**settings),
        **{name: config[name] for name in names if name in config},
    )


def of_file(path: Path) -> Any:
    """A model of Stable-Baselines3 or sb3-contrib; its class is found by its policy's.

    Raises:
        ConfigurationError: There is no such file, or it is no model.
    """
    try:
        data, _, _ = load_from_zip_file(path, device="cpu")
        assert data is not None
        name = _algorithm(data)
    except (OSError, zipfile.BadZipFile, ValueError, AssertionError, KeyError, AttributeError) as error:
        raise ConfigurationError(
            f"--policy: {str(path)!r} is no model that Stable-Baselines3 has saved ({error})"
        ) from None
    return ALGORITHMS[name].load(path, device="cpu")


def _algorithm(data: dict[str, Any]) -> str:
    """Whose model it is: the file names the policy's class alone."""
    package = data["policy_class"].__module__.split(".")[-2]
    if package == "common":  # PPO's, A2C's and TRPO's policies have one class
        return "PPO" if "clip_range" in data else "TRPO" if "cg_max_steps" in data else "A2C"
    found = [name for name in ALGORITHMS if name.lower() == package]
    if not found:
        raise ValueError(f"policies of {package!r} are not among {', '.join(ALGORITHMS)}")
    return found[0]
