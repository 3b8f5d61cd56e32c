"""One run: one arm with one seed, from wherever its folder stands to its last step."""

from __future__ import annotations

import contextlib
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from safe_wrappers import info as keys
from safe_wrappers.errors import RunStateError
from safe_wrappers.sb3 import InterventionCallback, LagrangianMultiplier
from safe_wrappers.wrappers.recording import COLUMNS

from ..config.models import ArmConfig
from ..files import append_row, only_writer, read_rows, write_json, write_rows
from ..processes import Progress, RunStoppedError
from .checkpoint import Checkpoint, latest_checkpoint, resume, save_checkpoint
from .folder import (
    CHECKPOINTS,
    EPISODES,
    EVALUATION,
    FINISHED_FILE,
    POLICY,
    check_finished,
    check_folder,
    claim_folder,
    is_finished,
)
from .model import buffer_size, learning_starts, new_model, whole_rollouts
from .policy import write_policy
from .stack import make_vec_env
from .trackers import run_logger

EPISODE_COLUMNS: Final = ("timesteps", "env", *COLUMNS)


def train_run(arm: ArmConfig, seed: int, folder: Path, progress: Progress) -> None:
    """Trains one arm with one seed, or goes on where the folder's last checkpoint stands.

    A finished run is left as it is, unless the arm's `total_steps` were raised: then it goes on, and its evaluation,
    which was of another policy, is deleted. A continued run starts new episodes (the envs' inner state is not
    saved), with env seeds of its own, so that no episode is seen twice.

    The folder becomes this run's (`run.json`) when its envs and its model could be made.

    Args:
        arm: What to train.
        seed: For the networks, the exploration and the envs.
        folder: The run's own folder.
        progress: Where to report to, and whether to stop.

    Raises:
        RunStateError: The folder belongs to another config, another process is at work in it, or its last checkpoint
            cannot be read.
        RunStoppedError: It was to stop, and has saved a checkpoint; says from which step the run will go on.
    """
    with only_writer(folder):
        check_folder(arm, seed, folder)
        if is_finished(arm, folder):
            claim_folder(arm, seed, folder)  # the last rollout may have gone beyond totals that were raised
            progress.steps(whole_rollouts(arm))
            return
        last = latest_checkpoint(folder / CHECKPOINTS)
        with contextlib.closing(make_vec_env(arm)) as envs:
            model = new_model(arm, seed, envs) if last is None else _continued(arm, envs, last, progress)
            claim_folder(arm, seed, folder)
            for outdated in (EVALUATION, POLICY):
                shutil.rmtree(folder / outdated, ignore_errors=True)
            (folder / FINISHED_FILE).unlink(missing_ok=True)
            if last is None or model.num_timesteps < arm.total_steps:
                facts = _learn(arm, seed, folder, envs, model, last, progress)
            else:  # it was killed with its last checkpoint there; not even an env is reset: the scaling would move
                facts = dict(last.facts)
            write_policy(arm, seed, folder, model)
            write_json(folder / FINISHED_FILE, facts)


def _learn(
    arm: ArmConfig,
    seed: int,
    folder: Path,
    envs: VecEnv,
    model: BaseAlgorithm,
    checkpoint: Checkpoint | None,
    progress: Progress,
) -> dict[str, Any]:
    # SB3 seeds env i with seed + i, so that seeds 0 and 1 would share all but one of their envs' episodes.
    vec_env = model.get_env()
    assert vec_env is not None
    stream = np.random.SeedSequence((seed, model.num_timesteps)).generate_state(1)[0]
    vec_env.seed(int(stream) >> 1)
    model.set_logger(run_logger(arm, seed, folder))
    begin = time.monotonic() - (0.0 if checkpoint is None else checkpoint.facts["elapsed_s"])

    def save(final: bool = False) -> dict[str, Any]:
        elapsed_s = time.monotonic() - begin
        times = [time_us for time_us in envs.get_attr("filter_time_us") if time_us is not None]
        facts = {
            "timesteps": model.num_timesteps,
            "elapsed_s": elapsed_s,
            "steps_per_s": model.num_timesteps / elapsed_s,
            "filter_time_us": float(np.mean(times)) if times else None,
        }
        save_checkpoint(folder / CHECKPOINTS, model, facts, final)
        return facts

    callbacks: list[BaseCallback] = [
        CheckpointCallback(arm.checkpoint_every, save, progress),
        InterventionCallback(),
        EpisodeRows(folder / EPISODES),
    ]
    if arm.learner.cost_limit is not None:
        callbacks.append(LagrangianMultiplier(arm.learner.cost_limit, arm.learner.multiplier_rate))
    try:
        model.learn(
            arm.total_steps - model.num_timesteps,
            callback=CallbackList(callbacks),
            reset_num_timesteps=checkpoint is None,
        )
    finally:
        model.logger.close()
    return save(final=True)


def _continued(arm: ArmConfig, envs: VecEnv, checkpoint: Checkpoint, progress: Progress) -> BaseAlgorithm:
    model = resume(checkpoint.folder, arm.algorithm, envs, arm.device, buffer_size(arm))
    if isinstance(model, OffPolicyAlgorithm) and model.num_timesteps < arm.total_steps:
        assert model.replay_buffer is not None
        if model.replay_buffer.size() == 0:  # it went on from a final checkpoint, which has none
            first = learning_starts(arm)
            model.learning_starts = model.num_timesteps + first
            progress.say(
                f"goes on from step {model.num_timesteps} with an empty replay buffer (a finished run keeps none):"
                f" {first} steps of random actions (learning_starts) before it learns again"
            )
    return model


def finished_checkpoint(arm: ArmConfig, seed: int, folder: Path) -> Checkpoint:
    """Returns the trained policy's checkpoint.

    Raises:
        RunStateError: The run is not finished, belongs to another config, or its policy is gone.
    """
    check_finished(arm, folder)
    check_folder(arm, seed, folder)
    checkpoint = latest_checkpoint(folder / CHECKPOINTS)
    if checkpoint is None:
        raise RunStateError(
            f"{str(folder / CHECKPOINTS)!r} is empty; delete {str(folder)!r} and train again."
        )
    return checkpoint


class EpisodeRows(BaseCallback):
    """Adds a row to a CSV file for each training episode, with the run's step count at its end.

    When a run goes on from a checkpoint, rows of later steps are cut first: those steps will be made again.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path

    def _on_training_start(self) -> None:
        rows = read_rows(self.path) if self.num_timesteps > 0 else []
        kept = [row for row in rows if row["timesteps"] <= self.num_timesteps]
        write_rows(self.path, EPISODE_COLUMNS, kept)

    def _on_step(self) -> bool:
        for env, info in enumerate(self.locals["infos"]):
            if keys.EPISODE_SUMMARY in info:
                row = {"timesteps": self.num_timesteps, "env": env, **info[keys.EPISODE_SUMMARY]}
                append_row(self.path, EPISODE_COLUMNS, row)
        return True


class CheckpointCallback(BaseCallback):
    """Saves between two rollouts, when the buffer is empty and the last update is done: now and then, and to stop.

    Reports the step count, at most twice a second.

    SB3's own callback saves in the midst of a rollout, from where nothing goes on bit for bit.
    """

    def __init__(self, every: int, save: Callable[[], object], progress: Progress) -> None:
        super().__init__()
        self.every = every
        self.save = save
        self.progress = progress
        self._next = 0.0

    def _on_training_start(self) -> None:
        self._last = self.num_timesteps

    def _on_rollout_start(self) -> None:
        stopping = self.progress.stopping()
        if self.num_timesteps - self._last >= self.every or (stopping and self.num_timesteps > 0):
            self._last = self.num_timesteps
            self.save()
        if stopping:
            raise RunStoppedError(f"stopped; goes on from step {self.num_timesteps:,}")

    def _on_step(self) -> bool:
        if time.monotonic() >= self._next:
            self._next = time.monotonic() + 0.5
            self.progress.steps(self.num_timesteps)
        return True

    def _on_training_end(self) -> None:
        self.progress.steps(self.num_timesteps)
