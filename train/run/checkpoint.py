"""Models as folders: SB3's files with all that training needs to go on, whole or not there."""

from __future__ import annotations

import json
import random
import shutil
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from safe_wrappers.errors import RunStateError

from ..config.algorithms import algorithm_class
from ..files import read_json, write_json
from .data_pickles import read_pickle
from .model_files import read_model, write_model

MODEL: Final = "model.zip"
NORMALIZE: Final = "vecnormalize.pkl"
_REPLAY: Final = "replay_buffer.pkl"
_RANDOM: Final = "random.json"
_STATE: Final = "state.json"
_NO_BUFFER: Final[dict[str, Any]] = {
    "buffer_size": 1,
    "replay_buffer_class": None,
    "replay_buffer_kwargs": {},
    "optimize_memory_usage": False,
}
"""A policy that only acts needs no replay buffer; SB3 would make one of full size."""


class Checkpoint(NamedTuple):
    """A folder, and what it says of the run so far."""

    folder: Path
    timesteps: int
    facts: Mapping[str, Any]
    """Over all restarts: `timesteps`, `elapsed_s`, `filter_time_us`."""


def load_model(folder: Path, algorithm: str, device: str) -> BaseAlgorithm:
    """The model of a folder, to act only."""
    return _load(folder, algorithm, device, None, _NO_BUFFER)


def resume(folder: Path, algorithm: str, env: VecEnv, device: str, buffer_size: int) -> BaseAlgorithm:
    """The model of a checkpoint with its replay buffer, in an env; and the random states of that time.

    A finished run's checkpoint has no replay buffer: there is an empty one of `buffer_size` transitions then.
    """
    if (folder / NORMALIZE).exists():
        scaled: VecNormalize = read_pickle(folder / NORMALIZE)
        scaled.set_venv(env)
        env = scaled
    replay = folder / _REPLAY
    model = _load(folder, algorithm, device, env, {"buffer_size": 1 if replay.exists() else buffer_size})
    if isinstance(model, OffPolicyAlgorithm) and model.replay_buffer is not None and replay.exists():
        buffer = read_pickle(replay)
        buffer.device = model.replay_buffer.device
        model.buffer_size = buffer.buffer_size * buffer.n_envs
        model.replay_buffer = buffer
    states = json.loads((folder / _RANDOM).read_text())
    version, internal, gauss = states["python"]
    random.setstate((version, tuple(internal), gauss))
    np.random.set_state(states["numpy"])
    torch.set_rng_state(torch.tensor(states["torch"], dtype=torch.uint8))
    return model


def _load(
    folder: Path, algorithm: str, device: str, env: VecEnv | None, changed: dict[str, Any]
) -> BaseAlgorithm:
    path = folder / MODEL
    try:
        return read_model(algorithm_class(algorithm), path, env, device, changed)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise RunStateError(
            f"{str(path)!r} cannot be read ({error}). Delete {str(folder)!r}: a run goes on from the checkpoint"
            " before it, if it has one."
        ) from error


def save_checkpoint(root: Path, model: BaseAlgorithm, facts: Mapping[str, Any], final: bool = False) -> Path:
    """Saves model, normaliser, replay buffer and random states under `root`, then drops older checkpoints.

    Everything is written into a hidden folder that is renamed at the end: there is no half checkpoint. A `final` one
    needs no replay buffer any more, and no older one beside it.

    Returns:
        The checkpoint's folder.
    """
    folder = root / f"step_{model.num_timesteps:012d}"
    if not folder.exists():  # else the model has not learned since
        temporary = root / ".writing"  # a killed process may have left one
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir(parents=True)
        try:
            _write(temporary, model, facts, final)
        except (OSError, RuntimeError) as error:  # torch makes a RuntimeError of what the system refuses
            shutil.rmtree(temporary, ignore_errors=True)
            cause = error.__context__ if isinstance(error.__context__, OSError) else error
            raise RunStateError(
                f"the checkpoint {str(folder)!r} cannot be written ({cause}). The one before it is whole: make room,"
                " and the same command goes on."
            ) from error
        temporary.rename(folder)
    older = [other for other in sorted(root.glob("step_*")) if other != folder]
    for old in older if final else older[:-1]:
        shutil.rmtree(old)
    return folder


def _write(folder: Path, model: BaseAlgorithm, facts: Mapping[str, Any], final: bool) -> None:
    save_policy(folder, model)
    if isinstance(model, OffPolicyAlgorithm) and not final:
        model.save_replay_buffer(folder / _REPLAY)
    of_numpy = np.random.get_state(legacy=False)
    of_numpy["state"]["key"] = of_numpy["state"]["key"].tolist()
    states = {"python": random.getstate(), "numpy": of_numpy, "torch": torch.get_rng_state().tolist()}
    write_json(folder / _RANDOM, states)
    write_json(folder / _STATE, facts)


def save_policy(folder: Path, model: BaseAlgorithm) -> None:
    """Saves a model, and its running statistics if it has any."""
    write_model(model, folder / MODEL)
    normalize = model.get_vec_normalize_env()
    if normalize is not None:
        normalize.save(str(folder / NORMALIZE))


def latest_checkpoint(root: Path) -> Checkpoint | None:
    """The newest checkpoint; None when the run has none yet."""
    folder = max(root.glob("step_*"), default=None)
    if folder is None:
        return None
    facts = read_json(folder / _STATE)
    return Checkpoint(folder, int(folder.name.removeprefix("step_")), facts)
