"""Trials that run together: trained, given up where others were better, evaluated, told to the study."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import zip_longest
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import yaml
from rich.console import Console

from safe_wrappers.errors import ConfigurationError, SafeWrappersError

from ..atomic import write_text
from ..config import ArmConfig, ExperimentConfig
from ..evaluation.summary import episode_file
from ..experiment import (
    check_training,
    evaluation_jobs,
    generations,
    summarize_experiment,
    training_jobs,
    write_cards,
)
from ..processes.job import Job
from ..processes.parallel import RunsFailedError, run_jobs
from ..tables import read_rows
from .space import FILTERED, Space
from .study import VIOLATIONS, is_worse_than_median, values_of

if TYPE_CHECKING:
    import optuna

CONFIG_FILE: Final = "config.yaml"
"""In a trial's folder: the config of an ordinary experiment."""
_LOOK_S: Final = 5.0


@dataclass
class Attempt:
    """A trial at work."""

    trial: optuna.Trial
    experiment: ExperimentConfig
    arm: ArmConfig
    batch: int
    """The number that its batch begins with."""
    reported: int = 0
    pruned: bool = False
    failed: bool = False
    _looked_at: float = field(default_factory=time.monotonic)

    @property
    def name(self) -> str:
        """Its folder's, and what its jobs' names begin with."""
        return self.experiment.name

    def look(self, now: float) -> bool:
        """`report`, now and then; whether the trial is given up."""
        if now - self._looked_at >= _LOOK_S:
            self._looked_at = now
            self.report()
        return self.pruned

    def report(self, ended: bool = False) -> None:
        """Tells the study the returns of the intervals between checkpoints that are over, and asks it after each."""
        every, seeds = self.arm.checkpoint_every, self.experiment.seeds
        tables = [
            read_rows(episode_file(self.experiment.run_folder(self.arm, seed), "training")) for seed in seeds
        ]
        reached = min(int(rows[-1]["timesteps"]) if rows else 0 for rows in tables)
        until = self.arm.total_steps if ended else min(reached, self.arm.total_steps)
        while not self.pruned and (self.reported + 1) * every <= until:
            begin, end = self.reported * every, (self.reported + 1) * every
            returns = [[row["return"] for row in rows if begin < row["timesteps"] <= end] for rows in tables]
            self.reported += 1
            if all(returns):  # an episode may be longer than that
                study = self.trial.study
                if end not in study.get_trials(deepcopy=False)[self.trial.number].intermediate_values:
                    self.trial.report(float(np.mean([np.mean(of_seed) for of_seed in returns])), step=end)
                self.pruned = is_worse_than_median(study, self.trial, self.batch)


def run_batch(space: Space, trials: list[optuna.Trial], console: Console, on: str | None = None) -> None:
    """Trains and evaluates trials, and tells their study what they came to.

    A trial is pruned by its returns, whether it was still at work then or had come to its end: what is pruned does
    not depend on how fast the machine is.

    Args:
        space: What is searched.
        trials: As `next_trials` gave them.
        console: Where progress, messages and failures are shown.
        on: Where: None for this machine, or `ray` or `ray:ADDRESS`.

    Raises:
        RunStateError: A trial's folder is another experiment's.
        Interrupted: A signal came; the trials go on when the study does.
    """
    attempts = [attempt for trial in trials if (attempt := _begin(space, trial, console)) is not None]
    by_name = {attempt.name: attempt for attempt in attempts}

    def unwanted(job: str) -> bool:
        return by_name[job.split(" ")[0]].look(time.monotonic())

    run = partial(run_jobs, workers=space.experiment.workers, console=console, on=on)
    for level in zip_longest(*(generations(attempt.experiment) for attempt in attempts), fillvalue=[]):
        jobs = _jobs(training_jobs, attempts, level)
        _attempt(by_name, console, partial(run, jobs, title="Training of trials", unwanted=unwanted))
    for attempt in attempts:
        if not attempt.failed:
            attempt.report(ended=True)
    levels = [attempt.experiment.arms for attempt in attempts]
    jobs = _jobs(evaluation_jobs, attempts, levels)
    _attempt(by_name, console, partial(run, jobs, title="Evaluation of trials"))
    for attempt in attempts:
        _tell(attempt)


def _begin(space: Space, trial: optuna.Trial, console: Console) -> Attempt | None:
    """The trial's experiment and its folder; None, and a failed trial, where its values are refused."""
    name = f"trial_{trial.number:04d}"
    try:
        settings, experiment = space.trial(name, values_of(space, trial))
        check_training(experiment)
    except ConfigurationError as error:
        _say(console, f"{name}: {error}")
        _close(trial, "FAIL")
        return None
    write_text(experiment.folder / CONFIG_FILE, yaml.safe_dump(settings, sort_keys=False))
    arm = next(arm for arm in experiment.arms if arm.name == space.arm.name)
    return Attempt(trial, experiment, arm, trial.number - trial.number % space.config.at_once)


def _jobs(make: Callable[..., list[Job]], attempts: list[Attempt], arms: Any) -> list[Job]:
    return [
        job
        for attempt, of_attempt in zip(attempts, arms, strict=True)
        if not (attempt.failed or attempt.pruned)
        for job in make(attempt.experiment, of_attempt, attempt.name)
    ]


def _attempt(by_name: dict[str, Attempt], console: Console, run: Callable[[], None]) -> None:
    """Runs jobs; the trials of those that fail have failed, and the others go on."""
    try:
        run()
    except RunsFailedError as error:
        _say(console, str(error))
        for job in error.names:
            by_name[job.split(" ")[0]].failed = True


def _tell(attempt: Attempt) -> None:
    if attempt.failed or attempt.pruned:
        _close(attempt.trial, "FAIL" if attempt.failed else "PRUNED")
        return
    write_cards(attempt.experiment)
    rows = [
        row
        for row in summarize_experiment(attempt.experiment).per_seed
        if row["condition"] == FILTERED and row["arm"] == attempt.arm.name
    ]
    if not all(VIOLATIONS in row for row in rows):
        raise SafeWrappersError(
            f"{attempt.name}: the task reported no cost in evaluation, so that nothing was judged."
        )
    attempt.trial.set_constraint(VIOLATIONS, float(np.mean([row[VIOLATIONS] for row in rows])))
    attempt.trial.study.tell(attempt.trial, float(np.mean([row["return"] for row in rows])))


def _close(trial: optuna.Trial, state: str) -> None:
    from optuna.trial import TrialState

    trial.study.tell(trial, state=TrialState[state])


def _say(console: Console, text: str) -> None:
    console.print(text, highlight=False, markup=False, soft_wrap=True)
