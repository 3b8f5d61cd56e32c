"""An experiment's steps: train all runs, evaluate them, sum them up."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from .config import ArmConfig, ExperimentConfig
from .evaluation.evaluate import evaluate_run
from .evaluation.summary import Summary, summarize, write_summary
from .hyperparameters import check_task
from .policies.card import write_card
from .processes.parallel import Job, run_jobs
from .processes.stopping import Interrupted
from .run.learner_callbacks import check_margins
from .run.start import Start
from .run.trackers import check_trackers
from .run.training import (
    check_finished,
    check_folder,
    check_start,
    is_outgrown,
    standing,
    train_run,
)
from .run.vec_envs import make_training_env
from .videos.record import delete_videos, record_videos


def train_experiment(experiment: ExperimentConfig, console: Console) -> None:
    """Trains what is not trained yet, arms times seeds in parallel; first the arms that others begin with.

    Raises:
        ConfigurationError: A task, a filter or an algorithm refuses its settings; nothing has been started.
        RunStateError: A run folder belongs to another config; nothing has been started.
        RunsFailedError: Some runs failed.
        Interrupted: A signal came; says where each run will go on.
    """
    # All arms and folders before the first step: nobody should learn after an hour that the last one is wrong.
    for arm in experiment.arms:
        env = make_training_env(arm)
        check_task(arm, env)
        if arm.env.reset_options:
            env.reset()  # the task alone knows its options
        check_margins(arm, env)
        check_trackers(arm)
        env.close()
        start = _start(experiment, arm, experiment.seeds[0])
        if start is not None:
            check_start(arm, start)
        for seed in experiment.seeds:
            check_folder(arm, seed, experiment.run_folder(arm, seed))
    for arm in experiment.arms:
        if any(is_outgrown(arm, experiment.run_folder(arm, seed)) for seed in experiment.seeds):
            delete_videos(experiment, arm)

    def training(arm: ArmConfig, seed: int) -> Callable[..., None]:
        return functools.partial(train_run, start=_start(experiment, arm, seed))

    try:
        every = sum(arm.total_steps for arm in experiment.arms) * len(experiment.seeds)
        before = 0
        for arms in _generations(experiment):
            now = sum(arm.total_steps for arm in arms) * len(experiment.seeds)
            others = before, every - before - now
            _run(
                experiment,
                arms,
                console,
                "Training",
                lambda arm: arm.total_steps,
                "steps",
                training,
                (),
                others,
            )
            before += now
    except Interrupted as stop:
        stop.standing = [
            f"{arm.name} seed {seed}: {standing(arm, experiment.run_folder(arm, seed))}"
            for seed in experiment.seeds
            for arm in experiment.arms
        ]
        raise
    _write_cards(experiment)


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
    every, evaluation = experiment.arms, lambda *_: evaluate_run
    _run(experiment, every, console, "Evaluation", lambda _: episodes, "episodes", evaluation, arguments)
    _write_cards(experiment)
    record_videos(experiment, console)


def summarize_experiment(experiment: ExperimentConfig) -> Summary:
    """Sums up what is there and writes it beside the runs."""
    summary = summarize(experiment)
    write_summary(summary, experiment.folder)
    return summary


def _write_cards(experiment: ExperimentConfig) -> None:
    for arm in experiment.arms:
        for seed in experiment.seeds:
            write_card(arm, seed, experiment.run_folder(arm, seed), experiment.evaluation_filter)


def _start(experiment: ExperimentConfig, arm: ArmConfig, seed: int) -> Start | None:
    """Whose policy a run begins with."""
    if arm.start_from is None:
        return None
    source = experiment.begins_with(arm)
    if source is None:
        return Start(arm.start_from, Path(arm.start_from))
    return Start(source.name, experiment.run_folder(source, seed), source)


def _generations(experiment: ExperimentConfig) -> Iterator[list[ArmConfig]]:
    """The arms, those first that others begin with."""
    left = list(experiment.arms)
    while left:
        ready = [arm for arm in left if experiment.begins_with(arm) not in left]
        yield ready
        left = [arm for arm in left if arm not in ready]


def _run(
    experiment: ExperimentConfig,
    arms: Sequence[ArmConfig],
    console: Console,
    title: str,
    total: Callable[[ArmConfig], int],
    unit: str,
    call: Callable[[ArmConfig, int], Callable[..., None]],
    more: tuple[Any, ...],
    others: tuple[int, int] = (0, 0),
) -> None:
    """Runs a job per arm and seed; `others` is the work of earlier and of later jobs."""
    # Seeds outside, arms inside: after the first wave there is already a pair to look at.
    jobs = [
        Job(
            f"{title.lower()} {arm.name} seed {seed}",
            total(arm),
            unit,
            call(arm, seed),
            (arm, seed, experiment.run_folder(arm, seed), *more),
        )
        for seed in experiment.seeds
        for arm in arms
    ]
    run_jobs(jobs, experiment.workers, console, title, *others)
