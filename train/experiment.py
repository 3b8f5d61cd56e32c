"""An experiment's steps: train all runs, evaluate them, sum them up."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.console import Console

from safe_wrappers.errors import ConfigurationError

from .config import ArmConfig, ExperimentConfig
from .evaluation.evaluate import evaluate_run
from .evaluation.summary import Summary, summarize, write_summary
from .policies import write_card
from .processes import Job
from .processes.parallel import run_jobs
from .run.folder import check_finished, check_folder, is_finished
from .run.model import check_task, whole_rollouts
from .run.stack import make_training_env
from .run.trackers import check_trackers
from .run.training import train_run
from .videos.record import delete_videos, record_videos


def train_experiment(experiment: ExperimentConfig, console: Console, on: str | None = None) -> None:
    """Trains what is not trained yet, arms times seeds in parallel; first the arms that others begin with.

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
    for arm in experiment.arms:
        if not all(is_finished(arm, experiment.run_folder(arm, seed)) for seed in experiment.seeds):
            delete_videos(experiment, arm)
    for arms in generations(experiment):
        run_jobs(training_jobs(experiment, arms), experiment.workers, console, "Training", on=on)
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
        if arm.start_from and not (experiment.begins_with(arm) or Path(arm.start_from).is_file()):
            raise ConfigurationError(f"arms.{arm.name}.start_from: there is no file {arm.start_from!r}.")
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
    for arm in experiment.arms:
        for seed in experiment.seeds:
            check_finished(arm, experiment.run_folder(arm, seed))
    jobs = evaluation_jobs(experiment, experiment.arms)
    run_jobs(jobs, experiment.workers, console, "Evaluation", on=on)
    write_cards(experiment)
    record_videos(experiment, console)


def summarize_experiment(experiment: ExperimentConfig) -> Summary:
    """Sums up what is there and writes it beside the runs."""
    summary = summarize(experiment)
    write_summary(summary, experiment.folder)
    return summary


def write_cards(experiment: ExperimentConfig) -> None:
    """Writes the card of every run's policy, with what is known of it by now."""
    for arm in experiment.arms:
        for seed in experiment.seeds:
            write_card(arm, seed, experiment.run_folder(arm, seed), experiment.evaluation_filter)


def _start(experiment: ExperimentConfig, arm: ArmConfig, seed: int) -> tuple[str, Path] | None:
    """Whose policy a run begins with, and where that is."""
    if arm.start_from is None:
        return None
    source = experiment.begins_with(arm)
    return arm.start_from, Path(arm.start_from) if source is None else experiment.run_folder(source, seed)


def generations(experiment: ExperimentConfig) -> Iterator[list[ArmConfig]]:
    """The arms, those first that others begin with."""
    left = list(experiment.arms)
    while left:
        ready = [arm for arm in left if experiment.begins_with(arm) not in left]
        yield ready
        left = [arm for arm in left if arm not in ready]


def training_jobs(experiment: ExperimentConfig, arms: Sequence[ArmConfig], of: str = "training") -> list[Job]:
    """A job per arm and seed, counted in steps; `of` begins their names."""
    # Seeds outside, arms inside: after the first wave there is already a pair to look at.
    return [
        Job(
            f"{of} {arm.name} seed {seed}",
            whole_rollouts(arm),
            "steps",
            functools.partial(train_run, start=_start(experiment, arm, seed)),
            (arm, seed, experiment.run_folder(arm, seed)),
        )
        for seed in experiment.seeds
        for arm in arms
    ]


def evaluation_jobs(
    experiment: ExperimentConfig, arms: Sequence[ArmConfig], of: str = "evaluation"
) -> list[Job]:
    """A job per arm and seed, counted in episodes; `of` begins their names."""
    settings, on = experiment.evaluation, experiment.evaluation_filter
    episodes = (1 if on.kind == "none" else 2) * settings.episodes
    return [
        Job(
            f"{of} {arm.name} seed {seed}",
            episodes,
            "episodes",
            evaluate_run,
            (arm, seed, experiment.run_folder(arm, seed), settings, on),
        )
        for seed in experiment.seeds
        for arm in arms
    ]
