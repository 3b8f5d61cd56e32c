"""An experiment's steps: train all runs, evaluate them, sum them up."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rich.console import Console

from .config import ArmConfig, ExperimentConfig
from .evaluation.evaluate import evaluate_run
from .evaluation.summary import Summary, summarize, write_summary
from .hyperparameters import check_task
from .processes.parallel import Job, run_jobs
from .processes.stopping import Interrupted
from .run.stack import make_stack
from .run.training import check_finished, check_folder, is_outgrown, standing, train_run
from .videos.record import delete_videos, record_videos


def train_experiment(experiment: ExperimentConfig, console: Console) -> None:
    """Trains what is not trained yet, arms times seeds in parallel.

    Raises:
        ConfigurationError: A task, a filter or an algorithm refuses its settings; nothing has been started.
        RunStateError: A run folder belongs to another config; nothing has been started.
        RunsFailedError: Some runs failed.
        Interrupted: A signal came; says where each run will go on.
    """
    # All arms and folders before the first step: nobody should learn after an hour that the last one is wrong.
    for arm in experiment.arms:
        env = make_stack(arm.env, arm.filter, arm.learner)
        check_task(arm, env)
        env.close()
        for seed in experiment.seeds:
            check_folder(arm, seed, experiment.run_folder(arm, seed))
    for arm in experiment.arms:
        if any(is_outgrown(arm, experiment.run_folder(arm, seed)) for seed in experiment.seeds):
            delete_videos(experiment, arm)
    try:
        _run(experiment, console, "Training", lambda arm: arm.total_steps, "steps", train_run, ())
    except Interrupted as stop:
        stop.standing = [
            f"{arm.name} seed {seed}: {standing(arm, experiment.run_folder(arm, seed))}"
            for seed in experiment.seeds
            for arm in experiment.arms
        ]
        raise


def evaluate_experiment(experiment: ExperimentConfig, console: Console) -> None:
    """Evaluates every trained run on the same episode seeds, filter off and on, and films one episode.

    Raises:
        RunStateError: A run is not trained to its end; nothing has been started.
        RunsFailedError: Some runs failed.
    """
    for arm in experiment.arms:
        for seed in experiment.seeds:
            check_finished(arm, experiment.run_folder(arm, seed))
    episodes = (1 if experiment.evaluation_filter.kind == "none" else 2) * experiment.evaluation.episodes
    arguments = (experiment.evaluation, experiment.evaluation_filter)
    _run(experiment, console, "Evaluation", lambda _: episodes, "episodes", evaluate_run, arguments)
    record_videos(experiment, console)


def summarize_experiment(experiment: ExperimentConfig) -> Summary:
    """Sums up what is there and writes it beside the runs."""
    summary = summarize(experiment)
    write_summary(summary, experiment.folder)
    return summary


def _run(
    experiment: ExperimentConfig,
    console: Console,
    title: str,
    total: Callable[[ArmConfig], int],
    unit: str,
    call: Callable[..., None],
    more: tuple[Any, ...],
) -> None:
    # Seeds outside, arms inside: after the first wave there is already a pair to look at.
    jobs = [
        Job(
            f"{title.lower()} {arm.name} seed {seed}",
            total(arm),
            unit,
            call,
            (arm, seed, experiment.run_folder(arm, seed), *more),
        )
        for seed in experiment.seeds
        for arm in experiment.arms
    ]
    run_jobs(jobs, experiment.workers, console, title)
