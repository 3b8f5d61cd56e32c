"""A trained policy for others: a folder of numbers and JSON, without pickled code.

SB3's `model.zip` and `vecnormalize.pkl` hold pickles, and whoever loads a pickle runs what is in it. Here the weights
and running statistics are arrays, and all else is made anew from the config.
"""

from __future__ import annotations

import io
import json
import re
import shutil
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from safe_wrappers.errors import ConfigurationError, RunStateError
from safe_wrappers.plants.env_checks import wrappers_of
from safe_wrappers.wrappers.cbf_action_filter import filter_inside

from ..atomic import write_bytes, write_json
from ..checksums import checksums, damage, read_facts
from ..config import NAIVE, ArmConfig
from ..config.algorithms import ALGORITHMS, ON_POLICY
from ..config.stored import stored_arm
from ..hyperparameters import constructor_arguments
from .policy import SpacesEnv
from .stack import make_stack

POLICY: Final = "policy"
"""In a run's folder."""
CONFIG: Final = "config.json"
MODEL: Final = "model.npz"
NORMALISATION: Final = "normalisation.npz"
FILTER: Final = "filter.json"
_TARGET: Final = "_target."
"""Target networks are lagging copies of others, and nearly half of the numbers; only training needs them."""
_OF_TRAINING: Final = ("replay_buffer_class", "replay_buffer_kwargs", "optimize_memory_usage")
"""A policy that only acts has no replay buffer."""
_PACKAGES: Final = ("safe-wrappers", "stable-baselines3", "gymnasium", "mujoco")
_ADDRESS: Final = re.compile(r" at 0x[0-9a-f]+")


def write_policy(arm: ArmConfig, seed: int, run: Path, model: BaseAlgorithm) -> Path:
    """Writes the policy of a finished run into `RUN/policy/`.

    Args:
        arm: Its arm.
        seed: Its seed.
        run: The run's folder.
        model: As it was trained.

    Returns:
        The folder; there is no half one.
    """
    folder, temporary = run / POLICY, run / f".{POLICY}"
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir()
    weights = {
        name: tensor.detach().cpu().numpy()
        for name, tensor in model.policy.state_dict().items()
        if _TARGET not in name
    }
    write_bytes(temporary / MODEL, _npz(weights))
    scaling = model.get_vec_normalize_env()
    if scaling is not None and scaling.norm_obs:
        write_bytes(temporary / NORMALISATION, _npz(_statistics(scaling)))
    write_json(temporary / FILTER, filter_spec(arm))
    config = {
        "arm": arm.name,
        "seed": seed,
        "config": arm.fingerprint(),
        "timesteps": model.num_timesteps,
        "observation_space": _described(model.observation_space),
        "action_space": _described(model.action_space),
        "versions": {name: version(name) for name in _PACKAGES},
        "files": checksums(sorted(temporary.iterdir())),
    }
    write_json(temporary / CONFIG, config)
    shutil.rmtree(folder, ignore_errors=True)
    temporary.rename(folder)
    return folder


@dataclass(frozen=True)
class PolicyFolder:
    """What `write_policy` wrote, verified; a source of a `TrainedPolicy`."""

    folder: Path
    arm: ArmConfig
    config: Mapping[str, Any]
    spec: Mapping[str, Any]
    """The filter that it was trained with: its config, and its constraints in words."""

    def load_model(self, algorithm: str, env: None, device: str) -> BaseAlgorithm:
        """The model, to act only, made from the config with the saved weights."""
        hyperparameters = {k: v for k, v in self.arm.hyperparameters.items() if k not in _OF_TRAINING}
        if algorithm not in ON_POLICY:
            hyperparameters["buffer_size"] = 1
        elif "n_steps" in hyperparameters:  # a rollout of all envs, which is here of one
            hyperparameters["n_steps"] *= self.arm.n_envs
        arm = replace(self.arm, hyperparameters=hyperparameters, learner=NAIVE)
        told = SpacesEnv(_space(self.config["observation_space"]), _space(self.config["action_space"]))
        envs = DummyVecEnv([lambda: told])
        # Warnings are of batches that do not fit a rollout: nothing is trained.
        with warnings.catch_warnings(action="ignore"):
            model: BaseAlgorithm = ALGORITHMS[algorithm](
                env=envs, device=device, **constructor_arguments(arm, envs)
            )
        with np.load(self.folder / MODEL, allow_pickle=False) as arrays:
            weights = {name: torch.as_tensor(arrays[name]) for name in arrays.files}
        targets = (name for name in model.policy.state_dict() if _TARGET in name and name not in weights)
        weights |= {name: weights[name.replace(_TARGET, ".")] for name in targets}
        model.policy.load_state_dict(weights)
        return model

    def load_normalize(self, env: VecEnv) -> VecEnv:
        """The running statistics around an env; the env itself if the run had none."""
        path = self.folder / NORMALISATION
        if not path.exists():
            return env
        with np.load(path, allow_pickle=False) as arrays:
            found = {name: arrays[name] for name in arrays.files}
        scaled = VecNormalize(
            env,
            training=False,
            norm_reward=False,
            clip_obs=float(found.pop("clip_obs")),
            epsilon=float(found.pop("epsilon")),
        )
        of_parts = scaled.obs_rms if isinstance(scaled.obs_rms, dict) else {"": scaled.obs_rms}
        for name, statistics in of_parts.items():
            for field in ("mean", "var", "count"):
                setattr(statistics, field, found[f"{name}/{field}"])
        return scaled


def read_policy(folder: Path) -> PolicyFolder:
    """Reads what `write_policy` wrote.

    Raises:
        ConfigurationError: It is no such folder.
        RunStateError: A file is missing, or not as it was written.
    """
    path = folder / CONFIG
    if not (path.is_file() and (folder / MODEL).is_file()):
        raise ConfigurationError(f"{str(folder)!r} is no policy's folder (it has no {CONFIG} and {MODEL})")
    try:
        config = json.loads(path.read_text())
        files, name, fingerprint = dict(config["files"]), config["arm"], config["config"]
    except (ValueError, KeyError, TypeError) as error:
        raise RunStateError(f"{str(path)!r} is unreadable: {error!r}") from error
    wrong = damage(folder, files)
    if wrong is not None:
        raise RunStateError(wrong)
    spec = json.loads((folder / FILTER).read_text())
    return PolicyFolder(folder, stored_arm(name, fingerprint), config, spec)


def policy_damage(folder: Path) -> str | None:
    """What is wrong with a run's policy, in words; None where it is whole, or the run's version left none."""
    if not folder.exists():
        return None
    try:
        files = read_facts(folder / CONFIG, "").get("files")
    except RunStateError as error:
        return str(error).partition(";")[0]
    return damage(folder, files) if files else f"{folder / CONFIG} is missing"


def filter_spec(arm: ArmConfig) -> dict[str, Any]:
    """The filter of an arm: its config, and its constraints in words."""
    env = make_stack(arm.env, arm.filter)
    spec = {"filter": arm.filter.plain(), "constraints": constraints_of(env)}
    env.close()
    return spec


def constraints_of(env: gym.Env[Any, Any]) -> list[str]:
    """The constraints of the filter in an env's stack, in words; without a `CBFActionFilter` others' wrappers."""
    found = filter_inside(env)
    if found is not None:
        return [_ADDRESS.sub("", repr(constraint)) for constraint in found.constraints]
    packages = ("gymnasium", "stable_baselines3", "safe_wrappers")
    kinds = [type(wrapper) for wrapper in wrappers_of(env)]
    return [kind.__name__ for kind in kinds if kind.__module__.partition(".")[0] not in packages]


def _statistics(scaling: VecNormalize) -> dict[str, Any]:
    of_parts = scaling.obs_rms if isinstance(scaling.obs_rms, dict) else {"": scaling.obs_rms}
    found: dict[str, Any] = {"clip_obs": scaling.clip_obs, "epsilon": scaling.epsilon}
    for name, statistics in of_parts.items():
        assert isinstance(statistics, RunningMeanStd)
        found |= {f"{name}/{field}": getattr(statistics, field) for field in ("mean", "var", "count")}
    return found


def _described(space: spaces.Space[Any]) -> dict[str, Any]:
    """A space as JSON has it."""
    kind = type(space).__name__
    match space:
        case spaces.Box():
            bounds = {"low": space.low.ravel().tolist(), "high": space.high.ravel().tolist()}
            return {"kind": kind, "shape": list(space.shape), "dtype": str(space.dtype), **bounds}
        case spaces.Discrete():
            return {"kind": kind, "n": int(space.n), "start": int(space.start)}
        case spaces.MultiDiscrete():
            return {"kind": kind, "nvec": space.nvec.tolist()}
        case spaces.MultiBinary():
            return {"kind": kind, "n": space.n}
        case spaces.Dict():
            return {"kind": kind, "spaces": [[name, _described(part)] for name, part in space.spaces.items()]}
    raise ConfigurationError(f"a policy for a space that Stable-Baselines3 does not take: {space!r}")


def _space(described: Mapping[str, Any]) -> spaces.Space[Any]:
    """The space that `_described` described."""
    settings = {key: value for key, value in described.items() if key != "kind"}
    match described["kind"]:
        case "Box":
            dtype, shape = np.dtype(settings["dtype"]), tuple(settings["shape"])
            low, high = (np.array(settings[key], dtype).reshape(shape) for key in ("low", "high"))
            return spaces.Box(low, high, shape, dtype.type)
        case "Dict":
            return spaces.Dict([(name, _space(part)) for name, part in settings["spaces"]])
        case kind:
            made: spaces.Space[Any] = getattr(spaces, kind)(**settings)
            return made


def _npz(arrays: Mapping[str, Any]) -> bytes:
    data = io.BytesIO()
    np.savez(data, **arrays)
    return data.getvalue()
