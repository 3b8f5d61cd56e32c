"""Checkpoints of one run: whole or not there, verified before they are read, the last two kept."""

from __future__ import annotations

import json
import random
import shutil
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from safe_wrappers.errors import RunStateError

from ..atomic import write_bytes, write_json
from ..checksums import checksums, damage
from ..config.algorithms import ALGORITHMS
from .data_pickles import pickles_of_model, read_pickle

MODEL: Final = "model.zip"
NORMALIZE: Final = "vecnormalize.pkl"
REPLAY: Final = "replay_buffer.pkl"
RANDOM: Final = "random.json"
STATE: Final = "state.json"
_NO_BUFFER: Final[dict[str, Any]] = {
    "buffer_size": 1,
    "replay_buffer_class": None,
    "replay_buffer_kwargs": {},
    "optimize_memory_usage": False,
}
"""A policy that only acts needs no replay buffer; SB3 would make one of full size, and HER's needs an env."""


@dataclass(frozen=True)
class Checkpoint:
    """A verified checkpoint."""

    folder: Path
    timesteps: int
    elapsed_s: float
    filter_time_us: float | None = None
    beside: tuple[str, ...] = ()
    """Files of the run's folder that are kept here, too."""

    def put_back(self, run: Path) -> None:
        """Makes the files of the run's folder what they were when the checkpoint was saved."""
        for name in self.beside:
            write_bytes(run / name, (self.folder / name).read_bytes())

    def load_model(
        self, algorithm: str, env: VecEnv | None, device: str, buffer_size: int | None = None
    ) -> BaseAlgorithm:
        """Loads the model; with an env also what training needs: replay buffer and random states.

        Args:
            algorithm: Its name in a config.
            env: To train in; None to act only.
            device: Torch's.
            buffer_size: Of the replay buffer, in transitions, if it should be larger than when the run began.
        """
        sizes = {} if buffer_size is None else {"buffer_size": buffer_size}
        changed = _NO_BUFFER if env is None else sizes
        path = self.folder / MODEL
        model: BaseAlgorithm = ALGORITHMS[algorithm].load(
            path, env=env, device=device, custom_objects=pickles_of_model(path) | changed
        )
        if env is not None:
            # A finished run's last checkpoint has no replay buffer.
            if isinstance(model, OffPolicyAlgorithm) and (self.folder / REPLAY).exists():
                empty, saved = model.replay_buffer, self._replay_buffer(model)
                assert empty is not None
                if empty.buffer_size > saved.buffer_size:
                    _move(saved, empty)
                else:
                    model.replay_buffer = saved
            _set_random_states(json.loads((self.folder / RANDOM).read_text()))
        return model

    def load_normalize(self, env: VecEnv) -> VecEnv:
        """Puts the saved running statistics around the env; returns the env itself if the run had none."""
        path = self.folder / NORMALIZE
        if not path.exists():
            return env
        scaled: VecNormalize = read_pickle(path)
        scaled.set_venv(env)
        return scaled

    def _replay_buffer(self, model: OffPolicyAlgorithm) -> ReplayBuffer:
        """The saved one, as `load_replay_buffer` makes it ready."""
        buffer: ReplayBuffer = read_pickle(self.folder / REPLAY)
        buffer.device = model.device
        if isinstance(buffer, HerReplayBuffer):
            assert model.env is not None
            buffer.set_env(model.env)
            with warnings.catch_warnings():
                # HER ends the episodes that were cut: a continued run starts new ones, as it should.
                warnings.filterwarnings("ignore", "The last trajectory in the replay buffer")
                buffer.truncate_last_trajectory()
        return buffer


def save_checkpoint(
    root: Path,
    model: BaseAlgorithm,
    facts: Mapping[str, Any],
    beside: Iterable[Path] = (),
    final: bool = False,
) -> Path:
    """Saves model, normaliser, replay buffer and random states under `root`, then drops older checkpoints.

    Everything is written into a hidden folder that is renamed at the end: there is no half checkpoint. One that
    could not be written leaves the disk as it was.

    Args:
        root: The run's folder of checkpoints.
        model: The model between two rollouts.
        facts: Of the run so far, over all restarts: `timesteps`, `elapsed_s`, `filter_time_us`.
        beside: Files of the run's folder that belong to this step; those that are there are kept, too.
        final: The run is finished: no replay buffer is needed any more, and no older checkpoint.

    Returns:
        The checkpoint's folder.
    """
    folder = root / f"step_{model.num_timesteps:012d}"
    temporary = root / ".writing"  # a killed process may have left one; its successor clears it
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    try:
        _write(temporary, model, facts, beside, final)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    # A damaged one that was passed over, or the start's of a rollout that was given up. It may be the only one: its
    # successor can be found, as the later of the two, before it is gone; that of a kill in between is whole, too.
    successor = root / f"{folder.name}.new"
    if folder.exists():
        if not successor.exists():
            temporary = temporary.rename(successor)
        shutil.rmtree(folder)
    temporary.rename(folder)
    shutil.rmtree(successor, ignore_errors=True)
    older = [other for other in _folders(root) if other != folder]
    for old in older if final else older[:-1]:
        shutil.rmtree(old)
    return folder


def _write(
    folder: Path, model: BaseAlgorithm, facts: Mapping[str, Any], beside: Iterable[Path], final: bool
) -> None:
    model.save(folder / MODEL)
    normalize = model.get_vec_normalize_env()
    if normalize is not None:
        normalize.save(str(folder / NORMALIZE))
    if isinstance(model, OffPolicyAlgorithm) and not final:
        model.save_replay_buffer(folder / REPLAY)
    write_json(folder / RANDOM, _random_states())
    kept = [path.name for path in beside if path.is_file()]
    for name in kept:
        shutil.copyfile(folder.parents[1] / name, folder / name)
    files = checksums(sorted(folder.iterdir()))
    write_json(folder / STATE, {**facts, "beside": kept, "files": files})


def latest_checkpoint(root: Path, warn: Callable[[str], None]) -> Checkpoint | None:
    """Finds the newest checkpoint whose files are as they were written.

    Args:
        root: The run's folder of checkpoints.
        warn: Told about each damaged checkpoint that is passed over.

    Returns:
        The checkpoint, or None when the run has none yet.

    Raises:
        RunStateError: There are checkpoints, and all are damaged; says which files and what to do.
    """
    damages: list[str] = []
    for folder in reversed(_folders(root)):
        damage = _damage(folder)
        if damage is None:
            state = json.loads((folder / STATE).read_text())
            if damages:
                warn(f"{damages[-1]}; continuing from the checkpoint before it, {folder}")
            return Checkpoint(
                folder,
                int(state["timesteps"]),
                float(state["elapsed_s"]),
                state.get("filter_time_us"),
                tuple(state.get("beside", ())),
            )
        damages.append(damage)
    if damages:
        raise RunStateError(
            f"Corrupted checkpoint: {'; '.join(damages)}. No other is left: delete {str(root.parent)!r} to"
            " train this run again from the start."
        )
    return None


def _move(old: ReplayBuffer, new: ReplayBuffer) -> None:
    """Moves transitions, oldest first, into an empty buffer that is larger."""
    # One row more: with `optimize_memory_usage` the newest transition's next observation is there.
    rows = np.arange(old.pos - old.size(), old.pos + 1) % old.buffer_size
    for name, value in vars(old).items():
        if isinstance(value, np.ndarray) and value.shape[:2] == (old.buffer_size, old.n_envs):
            getattr(new, name)[: len(rows)] = value[rows]
        elif name in ("observations", "next_observations"):  # a dict of arrays
            for key, array in value.items():
                getattr(new, name)[key][: len(rows)] = array[rows]
    new.pos = old.size()
    if isinstance(old, HerReplayBuffer) and isinstance(
        new, HerReplayBuffer
    ):  # rows in which episodes begin, and the next one will
        new.ep_start[: len(rows)] = (new.ep_start[: len(rows)] - rows[0]) % old.buffer_size
        new._current_ep_start[:] = new.pos


def _folders(root: Path) -> list[Path]:
    return sorted(root.glob("step_*"))


def _damage(folder: Path) -> str | None:
    state = folder / STATE
    try:
        files: dict[str, str] = json.loads(state.read_text())["files"]
    except (OSError, ValueError, KeyError, TypeError):
        return f"{state} is missing or unreadable"
    return damage(folder, files)


def _random_states() -> dict[str, Any]:
    of_numpy = np.random.get_state(legacy=False)
    of_numpy["state"]["key"] = of_numpy["state"]["key"].tolist()
    return {"python": random.getstate(), "numpy": of_numpy, "torch": torch.get_rng_state().tolist()}


def _set_random_states(states: dict[str, Any]) -> None:
    version, internal, gauss = states["python"]
    random.setstate((version, tuple(internal), gauss))
    np.random.set_state(states["numpy"])
    torch.set_rng_state(torch.tensor(states["torch"], dtype=torch.uint8))
