"""One run: one arm with one seed, from wherever its folder stands to its last step."""

from __future__ import annotations

import contextlib
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import CallbackList
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from safe_wrappers.errors import RunStateError
from safe_wrappers.sb3 import InterventionCallback

from ..atomic import write_json
from ..checksums import checksums, damage
from ..config import ArmConfig
from ..config.algorithms import ALGORITHMS
from ..hyperparameters import constructor_arguments, learning_starts, whole_rollouts
from ..processes.job import Progress
from ..processes.lock import only_writer
from ..processes.stopping import RunStoppedError, heeding_termination
from ..processes.storage import telling_of_storage
from .callbacks import (
    CheckpointCallback,
    EpisodeRows,
    ProgressCallback,
    StopCallback,
    TrainingStopped,
)
from .checkpoint import MODEL, Checkpoint, latest_checkpoint, save_checkpoint
from .folder import (
    CHECKPOINTS,
    EPISODES,
    EVALUATION,
    FINISHED_FILE,
    check_finished,
    check_folder,
    claim_folder,
    finished_facts,
    is_finished,
    is_outgrown,
)
from .learner_callbacks import learner_callbacks
from .portable import POLICY, policy_damage, write_policy
from .start import START_FILE, Policy, Start, begin_with, policy_of_file, policy_of_model, refuse_misfit
from .trackers import run_logger
from .vec_envs import make_training_env, make_vec_env

_BESIDE: Final = (EPISODES, START_FILE)
"""What lies beside the checkpoints and is kept in them, too."""


def train_run(
    arm: ArmConfig, seed: int, folder: Path, progress: Progress, start: Start | None = None
) -> None:
    """Trains one arm with one seed, or goes on where the folder's last checkpoint stands.

    A finished run is left as it is, unless the arm's `total_steps` were raised: then it goes on, and its evaluation,
    which was of another policy, is deleted. A continued run starts new episodes (the envs' inner state is not
    saved), with env seeds of its own, so that no episode is seen twice. Of a finished run, what is damaged is made
    again from its last checkpoint.

    The folder becomes this run's (`run.json`) when its envs and its model could be made.

    While it trains, SIGTERM does not end the process: the run saves a checkpoint as soon as it can, and stops.

    Args:
        arm: What to train.
        seed: For the networks, the exploration and the envs.
        folder: The run's own folder.
        progress: Where to report to.
        start: Whose policy a new run begins with; None: one drawn at random.

    Raises:
        ConfigurationError: The policy to begin with does not fit.
        RunStateError: The folder belongs to another config, another process is at work in it, all its checkpoints
            are damaged, or the disk is full or cannot be written to.
        RunStoppedError: SIGTERM came; says from which step the run will go on.
    """
    with telling_of_storage(folder), only_writer(folder):
        check_folder(arm, seed, folder)
        wrong = _finished_damage(folder)
        if wrong is None and is_finished(arm, folder):
            claim_folder(arm, seed, folder)  # the last rollout may have gone beyond totals that were raised
            progress.steps(whole_rollouts(arm))
            return
        checkpoint = latest_checkpoint(folder / CHECKPOINTS, progress.say)
        if wrong is not None:
            if checkpoint is None:
                raise RunStateError(
                    f"{wrong}, and no checkpoint is left to make it from; delete {str(folder)!r} to train again."
                )
            progress.say(f"{wrong}; made again from the last checkpoint")
        with contextlib.closing(make_vec_env(arm)) as envs:
            _train(arm, seed, folder, envs, checkpoint, progress, start)


def _train(
    arm: ArmConfig,
    seed: int,
    folder: Path,
    envs: VecEnv,
    checkpoint: Checkpoint | None,
    progress: Progress,
    start: Start | None,
) -> None:
    say = progress.say
    model = _new_model(arm, seed, envs) if checkpoint is None else _continued(arm, envs, checkpoint, say)
    begun = None
    if start is not None and checkpoint is None:
        begun = begin_with(model, f"arms.{arm.name}", start.name, _file_of(start, seed))
    claim_folder(arm, seed, folder)
    if checkpoint is not None:
        checkpoint.put_back(folder)
    if begun is not None:
        write_json(folder / START_FILE, begun)
        say(f"begins with the policy of {begun['from']}, {begun['timesteps']:,} steps old")
    if is_outgrown(arm, folder):
        for outdated in (EVALUATION, POLICY):
            shutil.rmtree(folder / outdated, ignore_errors=True)
    (folder / FINISHED_FILE).unlink(missing_ok=True)
    with heeding_termination() as asked_to_stop:
        if model.num_timesteps < arm.total_steps:
            facts = _learn(arm, seed, folder, envs, model, checkpoint, progress, asked_to_stop)
        else:  # it was killed with its last checkpoint there; not even an env is reset: the scaling would move
            assert checkpoint is not None
            facts = _facts(model, checkpoint.elapsed_s, envs, checkpoint)
        write_policy(arm, seed, folder, model)
        files = checksums(folder / name for name in _BESIDE)
        write_json(folder / FINISHED_FILE, facts | {"files": files})


def _learn(
    arm: ArmConfig,
    seed: int,
    folder: Path,
    envs: VecEnv,
    model: BaseAlgorithm,
    checkpoint: Checkpoint | None,
    progress: Progress,
    asked_to_stop: Callable[[], bool],
) -> dict[str, Any]:
    before_s = 0.0 if checkpoint is None else checkpoint.elapsed_s
    # SB3 seeds env i with seed + i, so that seeds 0 and 1 would share all but one of their envs' episodes.
    vec_env = model.get_env()
    assert vec_env is not None
    stream = np.random.SeedSequence((seed, model.num_timesteps)).generate_state(1)[0]
    vec_env.seed(int(stream) >> 1)
    model.set_logger(run_logger(arm, seed, folder))
    begin = time.monotonic()

    def elapsed_s() -> float:
        return before_s + time.monotonic() - begin

    def save(final: bool = False) -> dict[str, Any]:
        facts = _facts(model, elapsed_s(), envs, checkpoint)
        save_checkpoint(folder / CHECKPOINTS, model, facts, [folder / name for name in _BESIDE], final=final)
        return facts

    filtered = arm.filter.kind != "none"
    callbacks = CallbackList(
        [
            StopCallback(asked_to_stop),
            InterventionCallback(),
            EpisodeRows(folder / EPISODES),
            ProgressCallback(progress.steps, progress.figures, filtered),
            CheckpointCallback(arm.checkpoint_every, save),
            *learner_callbacks(arm),
        ]
    )
    try:
        model.learn(
            arm.total_steps - model.num_timesteps,
            callback=callbacks,
            reset_num_timesteps=checkpoint is None,
        )
    except TrainingStopped as stop:
        if model.num_timesteps > 0:
            save()
        lost = stop.reached - model.num_timesteps
        later = f"; {lost:,} later step{'s' * (lost > 1)} will be made again" if lost else ""
        raise RunStoppedError(f"stopped; goes on {_from_step(model.num_timesteps)}{later}") from None
    finally:
        model.logger.close()
    return save(final=True)


def _finished_damage(folder: Path) -> str | None:
    """What is wrong with what a finished run left beside its checkpoint."""
    try:
        facts = finished_facts(folder)
    except RunStateError as error:
        return str(error).partition(";")[0]
    if not facts:
        return None
    return damage(folder, facts.get("files", {})) or policy_damage(folder / POLICY)


def standing(arm: ArmConfig, folder: Path) -> str:
    """Where a run that nobody is working on stands: `finished`, or `from step 8,192` on."""
    if is_finished(arm, folder):
        return "finished"
    try:
        checkpoint = latest_checkpoint(folder / CHECKPOINTS, lambda _: None)
    except RunStateError as error:
        return str(error)
    return _from_step(0 if checkpoint is None else checkpoint.timesteps)


def _from_step(step: int) -> str:
    return f"from step {step:,}" if step else "from the start"


def finished_checkpoint(arm: ArmConfig, seed: int, folder: Path) -> Checkpoint:
    """Returns the trained policy's checkpoint.

    Raises:
        RunStateError: The run is not finished, belongs to another config, or its policy is damaged.
    """
    check_finished(arm, folder)
    check_folder(arm, seed, folder)
    checkpoint = latest_checkpoint(folder / CHECKPOINTS, lambda _: None)
    if checkpoint is None:
        raise RunStateError(
            f"{str(folder / CHECKPOINTS)!r} is empty; delete {str(folder)!r} and train again."
        )
    return checkpoint


def check_start(arm: ArmConfig, start: Start) -> None:
    """Refuses a policy to begin with that does not fit, before anything is trained.

    Raises:
        ConfigurationError: Other spaces, another policy or other scaling of observations; or no such file.
    """
    theirs = policy_of_file(start.path) if start.arm is None else _untrained(start.arm)
    refuse_misfit(f"arms.{arm.name}", start.name, theirs, _untrained(arm))


def _untrained(arm: ArmConfig) -> Policy:
    hyperparameters = dict(arm.hyperparameters)
    if "buffer_size" in hyperparameters:  # nothing will be replayed
        hyperparameters["buffer_size"] = 1
    envs = DummyVecEnv([lambda: make_training_env(arm)])
    policy = policy_of_model(_new_model(replace(arm, hyperparameters=hyperparameters), 0, envs))
    envs.close()
    return policy


def _file_of(start: Start, seed: int) -> Path:
    """The file of the policy that a run begins with."""
    if start.arm is None:
        return start.path
    return finished_checkpoint(start.arm, seed, start.path).folder / MODEL


def _new_model(arm: ArmConfig, seed: int, envs: VecEnv) -> BaseAlgorithm:
    if arm.normalize.observation or arm.normalize.reward:
        envs = VecNormalize(
            envs,
            norm_obs=arm.normalize.observation,
            norm_reward=arm.normalize.reward,
            gamma=arm.hyperparameters.get("gamma", 0.99),
        )
    model: BaseAlgorithm = ALGORITHMS[arm.algorithm](
        env=envs, seed=seed, device=arm.device, **constructor_arguments(arm, envs)
    )
    return model


def _continued(
    arm: ArmConfig, envs: VecEnv, checkpoint: Checkpoint, say: Callable[[str], None]
) -> BaseAlgorithm:
    buffer_size = arm.hyperparameters.get("buffer_size")
    model = checkpoint.load_model(arm.algorithm, checkpoint.load_normalize(envs), arm.device, buffer_size)
    if isinstance(model, OffPolicyAlgorithm) and model.num_timesteps < arm.total_steps:
        assert model.replay_buffer is not None
        if model.replay_buffer.size() == 0:  # it went on from a final checkpoint, which has none
            first = learning_starts(arm)
            model.learning_starts = model.num_timesteps + first
            say(
                f"goes on from step {model.num_timesteps} with an empty replay buffer (a finished run keeps none):"
                f" {first} steps of random actions (learning_starts) before it learns again"
            )
    return model


def _facts(
    model: BaseAlgorithm, elapsed_s: float, envs: VecEnv, checkpoint: Checkpoint | None
) -> dict[str, Any]:
    times = [time_us for time_us in envs.get_attr("filter_time_us") if time_us is not None]
    # A run that was killed when its last checkpoint was written makes no step any more.
    before = None if checkpoint is None else checkpoint.filter_time_us
    return {
        "timesteps": model.num_timesteps,
        "elapsed_s": elapsed_s,
        "steps_per_s": model.num_timesteps / elapsed_s,
        "filter_time_us": float(np.mean(times)) if times else before,
    }
