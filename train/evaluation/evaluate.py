"""Paired evaluation: every policy on the same episode seeds, with the filter on and with it off."""

from __future__ import annotations

import shutil
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import gymnasium as gym

from safe_wrappers import info as keys
from safe_wrappers.wrappers.record_interventions import COLUMNS

from ..config import ArmConfig, EvaluationConfig, FilterConfig
from ..files import only_writer, read_json, write_json, write_rows
from ..processes import Progress, RunStoppedError
from ..run.folder import EVALUATION, check_finished
from ..run.policy import TrainedPolicy
from ..run.stack import make_stack
from ..run.trackers import run_logger
from ..run.training import finished_checkpoint
from .step_log import StepLog, StepRecorder, load_steps, save_steps

EVALUATION_COLUMNS: Final = ("episode_seed", *COLUMNS)
STATE_FILE: Final = "evaluation.json"


def evaluation_folder(run_folder: Path) -> Path:
    """Where a run's evaluation lies.

    Per condition (`filter_off`, `filter_on`) a table of episodes `.csv`, the steps `_steps.npz`
    (`safe_wrappers.train.evaluation.step_log`), and for tasks seen from above what stood where, `_places.json`.
    """
    return run_folder / EVALUATION


def evaluated_steps(run_folder: Path, condition: str) -> StepLog | None:
    """The steps of a run's evaluation; None if it was not evaluated."""
    return load_steps(evaluation_folder(run_folder) / f"{condition}_steps.npz")


def conditions(arm: ArmConfig, default_filter: FilterConfig) -> dict[str, FilterConfig]:
    """The filter that is on in each condition of an arm's evaluation; "filter_on" is left out where there is none."""
    used = arm.filter if arm.filter.kind != "none" else default_filter
    return {"filter_off": FilterConfig()} | ({"filter_on": used} if used.kind != "none" else {})


def evaluate_run(
    arm: ArmConfig,
    seed: int,
    folder: Path,
    settings: EvaluationConfig,
    default_filter: FilterConfig,
    progress: Progress,
) -> None:
    """Evaluates a finished run, deterministically, with the filter off and on.

    Episode i starts from env seed `settings.seed + i`, whatever the arm, the training seed and the filter:
    the rows of two conditions can be compared one by one. Does nothing if this has been done already.

    Args:
        arm: The run's arm.
        seed: The run's seed.
        folder: The run's folder.
        settings: Episodes and their seeds.
        default_filter: The filter put on for an arm that has none of its own; "none" leaves that part out.
        progress: Where to report to.

    Raises:
        RunStateError: The run is not finished, its folder or policy cannot be used, or another process is at work in
            it.
    """
    check_finished(arm, folder)
    filters = conditions(arm, default_filter)
    with only_writer(folder):
        checkpoint = finished_checkpoint(arm, seed, folder)
        out = evaluation_folder(folder)
        state = {
            "settings": {"episodes": settings.episodes, "seed": settings.seed},
            "filter": filters.get("filter_on", FilterConfig()).plain(),
            "timesteps": checkpoint.timesteps,
        }
        if read_json(out / STATE_FILE) == state:
            return
        (out / STATE_FILE).unlink(missing_ok=True)
        shutil.rmtree(out, ignore_errors=True)  # or after a kill there would be rows of two settings
        policy = TrainedPolicy(arm, checkpoint.folder)
        logger = run_logger(arm, seed, folder)
        for at, (condition, used) in enumerate(filters.items()):
            rows: list[dict[str, Any]] = []
            with closing(make_stack(arm.env, used, arm.learner.in_evaluation)) as env:
                steps = StepRecorder(env)
                for episode_seed in range(settings.seed, settings.seed + settings.episodes):
                    figures = _episode(env, policy, episode_seed, steps)
                    rows.append({"episode_seed": episode_seed, **figures})
                    for key, value in figures.items():
                        logger.record_mean(f"evaluation_{condition}/{key}", float(value))
                    progress.steps(at * settings.episodes + len(rows))
                    if progress.stopping():
                        raise RunStoppedError("stopped; this evaluation begins again")
                log = steps.finish()
            logger.dump(checkpoint.timesteps)
            write_rows(out / f"{condition}.csv", EVALUATION_COLUMNS, rows)
            write_json(out / f"{condition}_places.json", steps.places)
            save_steps(out / f"{condition}_steps.npz", log)
        logger.close()
        write_json(out / STATE_FILE, state)


def _episode(
    env: gym.Env[Any, Any], policy: TrainedPolicy, episode_seed: int, steps: StepRecorder
) -> dict[str, Any]:
    """Runs an episode, and records its steps; its figures as `RecordInterventions` has them."""
    observation, _ = env.reset(seed=episode_seed)
    policy.begin(env)
    steps.begin(episode_seed)
    done = False
    while not done:
        steps.before(observation)
        action = policy(observation)
        observation, _, terminated, truncated, info = env.step(action)
        steps.after(action, info)
        done = terminated or truncated
    figures: dict[str, Any] = info[keys.EPISODE_SUMMARY]
    return figures
