"""Paired evaluation: every policy on the same episode seeds, filter on and off; and what of it is shown first."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, Final, NamedTuple

import gymnasium as gym

from safe_wrappers import info as keys
from safe_wrappers.wrappers.recording import COLUMNS

from ..config.models import ArmConfig, EvaluationConfig, ExperimentConfig, FilterConfig
from ..files import only_writer, read_json, read_rows, write_json, write_rows
from ..processes import Progress, RunStoppedError
from ..run.folder import EVALUATION, check_finished
from ..run.policy import TrainedPolicy
from ..run.stack import make_stack
from ..run.trackers import run_logger
from ..run.training import finished_checkpoint
from .step_log import StepRecorder, save_steps

EVALUATION_COLUMNS: Final = ("episode_seed", *COLUMNS)
STATE_FILE: Final = "evaluation.json"


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
    the rows of two conditions can be compared one by one. Does nothing if this has been done already. An arm without
    a filter of its own is given `default_filter`. Writes, per condition (`filter_off`, `filter_on`), a table of
    episodes `.csv`, and the steps `_steps.npz`.

    Raises:
        RunStateError: The run is not finished, its folder or policy cannot be used, or another process is at work in
            it.
    """
    check_finished(arm, folder)
    filters = conditions(arm, default_filter)
    with only_writer(folder):
        checkpoint = finished_checkpoint(arm, seed, folder)
        out = folder / EVALUATION
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
            with closing(make_stack(arm.env, used)) as env:
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
            save_steps(out / f"{condition}_steps.npz", log)
        logger.close()
        write_json(out / STATE_FILE, state)


def _episode(
    env: gym.Env[Any, Any], policy: TrainedPolicy, episode_seed: int, steps: StepRecorder
) -> dict[str, Any]:
    """Runs an episode, and records its steps; its figures as `RecordInterventions` has them."""
    observation, _ = env.reset(seed=episode_seed)
    policy.reset()
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


class Pair(NamedTuple):
    """A comparison: an arm without the filter (the filtered one itself where there is no other), and one with it."""

    bare: ArmConfig
    filtered: ArmConfig


class ShownEpisode(NamedTuple):
    """The evaluation episode that is looked at in every arm and condition."""

    seed: int  # of the training
    episode_seed: int
    reason: str  # how it was chosen, for the page


def compared_pairs(experiment: ExperimentConfig) -> list[Pair]:
    """What the headline compares.

    - The first arm with a filter, and the first one without a filter on the same env (or, where there is none,
      the filtered arm with its filter off);
    - where no arm has a filter but the evaluation does: every arm, with it off and on;
    - nothing where there is no filter at all.
    """
    filtered = next((arm for arm in experiment.arms if arm.filter.kind != "none"), None)
    if filtered is not None:
        bare = (arm for arm in experiment.arms if arm.filter.kind == "none" and arm.env == filtered.env)
        return [Pair(next(bare, filtered), filtered)]
    if experiment.evaluation_filter.kind != "none":
        return [Pair(arm, arm) for arm in experiment.arms]
    return []


def shown_episode(experiment: ExperimentConfig) -> ShownEpisode | None:
    """The evaluation episode with the median return of the headline's policy; None before any evaluation.

    The policy is that of the first filtered arm with the filter on, or of the first arm where nothing is filtered.
    """
    pair = next(iter(compared_pairs(experiment)), None)
    arm, condition = (experiment.arms[0], "filter_off") if pair is None else (pair.filtered, "filter_on")
    seed = experiment.seeds[0]
    rows = read_rows(experiment.run_folder(arm, seed) / EVALUATION / f"{condition}.csv")
    if not rows:
        return None
    typical = typical_seed({int(row["episode_seed"]): row["return"] for row in rows})
    words = f"“{arm.name}” with the {condition.replace('_', ' ')}"
    reason = (
        f"Episode seed {typical}, policies of training seed {seed}: of the {len(rows)} evaluation episodes the one"
        f" with the median return of {words}."
    )
    return ShownEpisode(seed, typical, reason)


def typical_seed(returns: Mapping[int, float]) -> int:
    """The episode seed with the median return (of an even number the lower one)."""
    ordered = sorted(returns, key=lambda seed: (returns[seed], seed))
    return ordered[(len(ordered) - 1) // 2]
