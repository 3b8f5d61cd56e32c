"""One run: one arm with one seed, from wherever its folder stands to its last step."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Mapping
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
from ..config import ArmConfig
from ..config.algorithms import ALGORITHMS
from ..config.models import without_default_buffer_size
from ..hyperparameters import constructor_arguments, learning_starts
from ..processes.job import Progress
from ..processes.lock import only_writer
from ..processes.stopping import RunStoppedError, heeding_termination
from .callbacks import (
    CheckpointCallback,
    EpisodeRows,
    ProgressCallback,
    StopCallback,
    TrainingStopped,
)
from .checkpoint import MODEL, Checkpoint, latest_checkpoint, save_checkpoint
from .learner_callbacks import learner_callbacks
from .portable import POLICY, write_policy
from .start import START_FILE, Policy, Start, begin_with, policy_of_file, policy_of_model, refuse_misfit
from .trackers import run_logger
from .vec_envs import make_training_env, make_vec_env

RUN_FILE: Final = "run.json"
FINISHED_FILE: Final = "finished.json"
CHECKPOINTS: Final = "checkpoints"
EVALUATION: Final = "evaluation"


def train_run(
    arm: ArmConfig, seed: int, folder: Path, progress: Progress, start: Start | None = None
) -> None:
    """Trains one arm with one seed, or goes on where the folder's last checkpoint stands.

    A finished run is left as it is, unless the arm's `total_steps` were raised: then it goes on, and its evaluation,
    which was of another policy, is deleted. A continued run starts new episodes (the envs' inner state is not
    saved), with env seeds of its own, so that no episode is seen twice.

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
        RunStateError: The folder belongs to another config, another process is at work in it, or all its
            checkpoints are damaged.
        RunStoppedError: SIGTERM came; says from which step the run will go on.
    """
    with only_writer(folder):
        check_folder(arm, seed, folder)
        if _is_finished(arm, folder):
            _claim_folder(arm, seed, folder)  # the last rollout may have gone beyond totals that were raised
            progress.steps(arm.total_steps)
            return
        checkpoint = latest_checkpoint(folder / CHECKPOINTS, progress.say)
        envs = make_vec_env(arm)
        try:
            _train(arm, seed, folder, envs, checkpoint, progress, start)
        finally:
            envs.close()


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
    _claim_folder(arm, seed, folder)
    if begun is not None:
        write_json(folder / START_FILE, begun)
        say(f"begins with the policy of {begun['from']}, {begun['timesteps']:,} steps old")
    if is_outgrown(arm, folder):
        for outdated in (EVALUATION, POLICY):
            shutil.rmtree(folder / outdated, ignore_errors=True)
        (folder / FINISHED_FILE).unlink()
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

    def save() -> None:
        save_checkpoint(folder / CHECKPOINTS, model, elapsed_s())

    filtered = arm.filter.kind != "none"
    with heeding_termination() as asked_to_stop:
        callbacks = CallbackList(
            [
                StopCallback(asked_to_stop),
                InterventionCallback(),
                EpisodeRows(folder / "episodes.csv"),
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
        save_checkpoint(folder / CHECKPOINTS, model, elapsed_s(), final=True)
        write_policy(arm, seed, folder, model)
        write_json(folder / FINISHED_FILE, _facts(model, elapsed_s(), envs))


def standing(arm: ArmConfig, folder: Path) -> str:
    """Where a run that nobody is working on stands: `finished`, or `from step 8,192` on."""
    if _is_finished(arm, folder):
        return "finished"
    try:
        checkpoint = latest_checkpoint(folder / CHECKPOINTS, lambda _: None)
    except RunStateError as error:
        return str(error)
    return _from_step(0 if checkpoint is None else checkpoint.timesteps)


def _from_step(step: int) -> str:
    return f"from step {step:,}" if step else "from the start"


def check_finished(arm: ArmConfig, folder: Path) -> None:
    """Refuses a run that is not trained to its end.

    Raises:
        RunStateError: It is not.
    """
    if not _is_finished(arm, folder):
        raise RunStateError(
            f"The run in {str(folder)!r} is not trained to its end; run `safe-wrappers train` (or `compare`)."
        )


def is_outgrown(arm: ArmConfig, folder: Path) -> bool:
    """Whether the run was finished with fewer steps than it should have now: what shows its policy is out of date."""
    return (folder / FINISHED_FILE).exists() and not _is_finished(arm, folder)


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


def check_folder(arm: ArmConfig, seed: int, folder: Path) -> None:
    """Refuses a folder that belongs to another config; `total_steps` may be more than what it was begun with.

    Raises:
        RunStateError: Another config's; shows the settings that differ.
    """
    path = folder / RUN_FILE
    if not path.exists():
        if (folder / CHECKPOINTS).exists():
            raise RunStateError(
                f"{str(folder)!r} has checkpoints but no {RUN_FILE} that says what they are of; delete it, or"
                " choose another `name` or `output`."
            )
        return
    try:
        theirs = json.loads(path.read_text())
        without_default_buffer_size(theirs.get("config", {}))  # older folders have it
        there, here = _flat(theirs), _flat(json.loads(json.dumps(_identity(arm, seed))))
    except (ValueError, AttributeError):
        raise RunStateError(f"{str(path)!r} is unreadable; delete {str(folder)!r} to train again.") from None
    differ = {key for key in there.keys() | here.keys() if there.get(key, "unset") != here.get(key, "unset")}
    if there.get("total_steps", 0) <= arm.total_steps:
        differ.discard("total_steps")
    if differ:
        lines = [
            f"  {key}: {there.get(key, 'unset')!r} in the folder, {here.get(key, 'unset')!r} in the config"
            + " (it can be raised, not lowered)" * (key == "total_steps")
            for key in sorted(differ)
        ]
        raise RunStateError(
            f"The run folder {str(folder)!r} belongs to another config:\n" + "\n".join(lines) + "\n"
            "Choose another `name` or `output`, go back to its settings, or delete the folder."
        )


def _claim_folder(arm: ArmConfig, seed: int, folder: Path) -> None:
    """Marks a folder that `check_folder` let through as this run's, or as one whose total was raised."""
    path = folder / RUN_FILE
    if not path.exists() or json.loads(path.read_text())["config"].get("total_steps") != arm.total_steps:
        write_json(path, _identity(arm, seed))


def _identity(arm: ArmConfig, seed: int) -> dict[str, Any]:
    return {"arm": arm.name, "seed": seed, "config": arm.fingerprint()}


def _is_finished(arm: ArmConfig, folder: Path) -> bool:
    path = folder / FINISHED_FILE
    return path.exists() and int(json.loads(path.read_text())["timesteps"]) >= arm.total_steps


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


def _facts(model: BaseAlgorithm, elapsed_s: float, envs: VecEnv) -> dict[str, Any]:
    times = [time_us for time_us in envs.get_attr("filter_time_us") if time_us is not None]
    return {
        "timesteps": model.num_timesteps,
        "elapsed_s": elapsed_s,
        "steps_per_s": model.num_timesteps / elapsed_s,
        "filter_time_us": float(np.mean(times)) if times else None,
    }
