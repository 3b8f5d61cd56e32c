"""One run: one arm with one seed, from wherever its folder stands to its last step."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import CallbackList
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from safe_wrappers.errors import RunStateError
from safe_wrappers.sb3 import InterventionCallback

from .algorithms import ALGORITHMS
from .atomic import write_json
from .checkpoint import Checkpoint, latest_checkpoint, save_checkpoint
from .config import ArmConfig
from .hyperparameters import constructor_arguments
from .lock import only_writer
from .run_callbacks import CheckpointCallback, EpisodeRows, ProgressCallback
from .vec_envs import make_vec_env

RUN_FILE: Final = "run.json"
FINISHED_FILE: Final = "finished.json"
CHECKPOINTS: Final = "checkpoints"


@dataclass(frozen=True)
class Progress:
    """Where a run reports to: its steps so far, and lines that a person should read."""

    steps: Callable[[int], None]
    say: Callable[[str], None]


def train_run(arm: ArmConfig, seed: int, folder: Path, progress: Progress) -> None:
    """Trains one arm with one seed, or goes on where the folder's last checkpoint stands.

    A finished run is left as it is. A continued run starts new episodes (the envs' inner state is not saved),
    with env seeds of its own, so that no episode is seen twice.

    Args:
        arm: What to train.
        seed: For the networks, the exploration and the envs.
        folder: The run's own folder.
        progress: Where to report to.

    Raises:
        RunStateError: The folder belongs to another config, another process is at work in it, or all its
            checkpoints are damaged.
    """
    with only_writer(folder):
        claim_folder(arm, seed, folder)
        if (folder / FINISHED_FILE).exists():
            progress.steps(arm.total_steps)
            return
        checkpoint = latest_checkpoint(folder / CHECKPOINTS, progress.say)
        envs = make_vec_env(arm)
        try:
            _train(arm, seed, folder, envs, checkpoint, progress)
        finally:
            envs.close()


def _train(
    arm: ArmConfig,
    seed: int,
    folder: Path,
    envs: VecEnv,
    checkpoint: Checkpoint | None,
    progress: Progress,
) -> None:
    model = _new_model(arm, seed, envs) if checkpoint is None else _continued(arm, envs, checkpoint)
    before_s = 0.0 if checkpoint is None else checkpoint.elapsed_s
    # SB3 seeds env i with seed + i, so that seeds 0 and 1 would share all but one of their envs' episodes.
    vec_env = model.get_env()
    assert vec_env is not None
    stream = np.random.SeedSequence((seed, model.num_timesteps)).generate_state(1)[0]
    vec_env.seed(int(stream) >> 1)
    model.set_logger(configure(str(folder / "tensorboard"), ["tensorboard"]))
    start = time.monotonic()

    def elapsed_s() -> float:
        return before_s + time.monotonic() - start

    def save() -> None:
        save_checkpoint(folder / CHECKPOINTS, model, elapsed_s())

    callbacks = CallbackList(
        [
            InterventionCallback(),
            EpisodeRows(folder / "episodes.csv"),
            ProgressCallback(progress.steps),
            CheckpointCallback(arm.checkpoint_every, save),
        ]
    )
    model.learn(
        arm.total_steps - model.num_timesteps, callback=callbacks, reset_num_timesteps=checkpoint is None
    )
    model.logger.close()
    save_checkpoint(folder / CHECKPOINTS, model, elapsed_s(), final=True)
    write_json(folder / FINISHED_FILE, _facts(model, elapsed_s(), envs))


def check_finished(folder: Path) -> None:
    """Refuses a run that is not trained to its end.

    Raises:
        RunStateError: It is not.
    """
    if not (folder / FINISHED_FILE).exists():
        raise RunStateError(
            f"The run in {str(folder)!r} is not trained to its end; run `safe-wrappers train` (or `compare`)."
        )


def finished_checkpoint(arm: ArmConfig, seed: int, folder: Path) -> Checkpoint:
    """Returns the trained policy's checkpoint.

    Raises:
        RunStateError: The run is not finished, belongs to another config, or its policy is damaged.
    """
    check_finished(folder)
    claim_folder(arm, seed, folder)
    checkpoint = latest_checkpoint(folder / CHECKPOINTS, lambda _: None)
    if checkpoint is None:
        raise RunStateError(
            f"{str(folder / CHECKPOINTS)!r} is empty; delete {str(folder)!r} and train again."
        )
    return checkpoint


def claim_folder(arm: ArmConfig, seed: int, folder: Path) -> None:
    """Marks a new folder as this run's; refuses one that belongs to another config.

    Raises:
        RunStateError: Another config's; shows the settings that differ.
    """
    path = folder / RUN_FILE
    ours = {"arm": arm.name, "seed": seed, "config": arm.fingerprint()}
    if not path.exists():
        if (folder / CHECKPOINTS).exists():
            raise RunStateError(
                f"{str(folder)!r} has checkpoints but no {RUN_FILE} that says what they are of; delete it, or"
                " choose another `name` or `output`."
            )
        write_json(path, ours)
        return
    try:
        theirs = json.loads(path.read_text())
        there, here = _flat(theirs), _flat(json.loads(json.dumps(ours)))
    except (ValueError, AttributeError):
        raise RunStateError(f"{str(path)!r} is unreadable; delete {str(folder)!r} to train again.") from None
    lines = [
        f"  {key}: {there.get(key, 'unset')!r} in the folder, {here.get(key, 'unset')!r} in the config"
        for key in sorted(there.keys() | here.keys())
        if there.get(key, "unset") != here.get(key, "unset")
    ]
    if lines:
        raise RunStateError(
            f"The run folder {str(folder)!r} belongs to another config:\n" + "\n".join(lines) + "\n"
            "Choose another `name` or `output`, go back to its settings, or delete the folder."
        )


def _flat(value: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, item in value.items():
        name = key if not prefix and key != "config" else f"{prefix}.{key}".lstrip(".")
        if isinstance(item, dict) and item:
            flat.update(_flat(item, "" if name == "config" else name))
        else:
            flat[name] = item
    return flat


def _new_model(arm: ArmConfig, seed: int, envs: VecEnv) -> BaseAlgorithm:
    if arm.normalize.observation or arm.normalize.reward:
        envs = VecNormalize(
            envs,
            norm_obs=arm.normalize.observation,
            norm_reward=arm.normalize.reward,
            gamma=arm.hyperparameters.get("gamma", 0.99),
        )
    settings = {"policy": "MlpPolicy", **constructor_arguments(arm, envs)}
    model: BaseAlgorithm = ALGORITHMS[arm.algorithm](env=envs, seed=seed, device=arm.device, **settings)
    return model


def _continued(arm: ArmConfig, envs: VecEnv, checkpoint: Checkpoint) -> BaseAlgorithm:
    return checkpoint.load_model(arm.algorithm, checkpoint.load_normalize(envs), arm.device)


def _facts(model: BaseAlgorithm, elapsed_s: float, envs: VecEnv) -> dict[str, Any]:
    times = [time_us for time_us in envs.get_attr("filter_time_us") if time_us is not None]
    return {
        "timesteps": model.num_timesteps,
        "elapsed_s": elapsed_s,
        "steps_per_s": model.num_timesteps / elapsed_s,
        "filter_time_us": float(np.mean(times)) if times else None,
    }
