"""An experiment's steps: train all runs, evaluate them, sum them up."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from rich.console import Console

from .config.models import ArmConfig, ExperimentConfig
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
    """Trains what is not trained yet, arms times seeds in parallel; `on` as `run_jobs` takes it."""
    check_training(experiment)
    run_jobs(training_jobs(experiment), experiment.workers, console, "Training", on=on)
    write_cards(experiment)


def check_training(experiment: ExperimentConfig) -> None:
    """Refuses an experiment before its first step: nobody should learn after an hour that the last arm is wrong."""
    for arm in experiment.arms:
        env = make_training_env(arm)
        check_task(arm, env)
        env.reset()  # the task alone knows its options, and a filter of one's own is asked here first
        check_trackers(arm)
        env.close()
        for seed in experiment.seeds:
            check_folder(arm, seed, experiment.run_folder(arm, seed))


def evaluate_experiment(experiment: ExperimentConfig, console: Console, on: str | None = None) -> None:
    """Evaluates every trained run on the same episode seeds, filter off and on, and films one of them."""
    for arm, _, folder in _runs(experiment):
        check_finished(arm, folder)
    how = experiment.evaluation, experiment.evaluation_filter
    episodes = (1 if how[1].kind == "none" else 2) * how[0].episodes
    jobs = [
        Job(
            f"evaluation {arm.name} seed {seed}",
            episodes,
            "episodes",
            evaluate_run,
            (arm, seed, folder, *how),
        )
        for arm, seed, folder in _runs(experiment)
    ]
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
    for arm, seed, folder in _runs(experiment):
        write_card(arm, seed, folder)


def training_jobs(experiment: ExperimentConfig) -> list[Job]:
    """A job per arm and seed, counted in steps."""
    return [
        Job(f"training {arm.name} seed {seed}", whole_rollouts(arm), "steps", train_run, (arm, seed, folder))
        for arm, seed, folder in _runs(experiment)
    ]


def _runs(experiment: ExperimentConfig) -> Iterator[tuple[ArmConfig, int, Path]]:
    # Seeds outside, arms inside: after the first wave there is already a pair to look at.
    for seed in experiment.seeds:
        for arm in experiment.arms:
            yield arm, seed, experiment.run_folder(arm, seed)
