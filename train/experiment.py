"""An experiment's steps: train all runs, evaluate them, sum them up."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from rich.console import Console

from .config import ArmConfig, ExperimentConfig
from .evaluation.evaluate import evaluate_run
from .evaluation.summary import Summary, summarize, write_summary
from .policies import write_card
from .processes import Job
from .processes.parallel import run_jobs
from .run.folder import check_finished, check_folder
from .run.model import check_task, whole_rollouts
from .run.stack import make_training_env
from .run.trackers import check_trackers
from .run.training import train_run
from .videos import record_videos


def train_experiment(experiment: ExperimentConfig, console: Console, on: str | None = None) -> None:
    """Trains what is not trained yet, arms times seeds in parallel.

    Args:
        experiment: What to train.
        console: Where progress, messages and failures are shown.
        on: Where: None for this machine, or `ray` or `ray:ADDRESS`.

    Raises:
        ConfigurationError: A task, a filter or an algorithm refuses its settings; nothing has been started.
        RunStateError: A run folder belongs to another config; nothing has been started.
        RunsFailedError: Some runs failed.
        Interrupted: A signal came; the same command goes on.
    """
    check_training(experiment)
    run_jobs(training_jobs(experiment), experiment.workers, console, "Training", on=on)
    write_cards(experiment)


def check_training(experiment: ExperimentConfig) -> None:
    """Refuses an experiment before its first step: nobody should learn after an hour that the last arm is wrong.

    Raises:
        ConfigurationError: A task, a filter or an algorithm refuses its settings.
        RunStateError: A run folder belongs to another config.
    """
    for arm in experiment.arms:
        env = make_training_env(arm)
        check_task(arm, env)
        env.reset()  # the task alone knows its options, and a filter of one's own is asked here first
        check_trackers(arm)
        env.close()
        for seed in experiment.seeds:
            check_folder(arm, seed, experiment.run_folder(arm, seed))


def evaluate_experiment(experiment: ExperimentConfig, console: Console, on: str | None = None) -> None:
    """Evaluates every trained run on the same episode seeds, filter off and on, and films two of them.

    Args:
        experiment: Whose runs to evaluate.
        console: Where progress, messages and failures are shown.
        on: Where to evaluate, as in training; films are made on this machine.

    Raises:
        RunStateError: A run is not trained to its end; nothing has been started.
        RunsFailedError: Some runs failed.
    """
    for arm, _, folder in _runs(experiment):
        check_finished(arm, folder)
    run_jobs(evaluation_jobs(experiment), experiment.workers, console, "Evaluation", on=on)
    write_cards(experiment)
    record_videos(experiment, console)


def summarize_experiment(experiment: ExperimentConfig) -> Summary:
    """Sums up what is there and writes it beside the runs."""
    summary = summarize(experiment)
    write_summary(summary, experiment.folder)
    return summary


def write_cards(experiment: ExperimentConfig) -> None:
    """Writes the card of every run's policy, with what is known of it by now."""
    for arm, seed, folder in _runs(experiment):
        write_card(arm, seed, folder)


def training_jobs(experiment: ExperimentConfig) -> list[Job]:
    """A job per arm and seed, counted in steps."""
    return [
        Job(f"training {arm.name} seed {seed}", whole_rollouts(arm), "steps", train_run, (arm, seed, folder))
        for arm, seed, folder in _runs(experiment)
    ]


def evaluation_jobs(experiment: ExperimentConfig) -> list[Job]:
    """A job per arm and seed, counted in episodes."""
    settings, on = experiment.evaluation, experiment.evaluation_filter
    episodes = (1 if on.kind == "none" else 2) * settings.episodes
    return [
        Job(
            f"evaluation {arm.name} seed {seed}",
            episodes,
            "episodes",
            evaluate_run,
            (arm, seed, folder, settings, on),
        )
        for arm, seed, folder in _runs(experiment)
    ]


def _runs(experiment: ExperimentConfig) -> Iterator[tuple[ArmConfig, int, Path]]:
    # Seeds outside, arms inside: after the first wave there is already a pair to look at.
    for seed in experiment.seeds:
        for arm in experiment.arms:
            yield arm, seed, experiment.run_folder(arm, seed)
