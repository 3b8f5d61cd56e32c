"""`safe-wrappers sweep`: hyperparameters and filter parameters by Optuna, for the most return at cost zero.

A trial is an ordinary experiment with values of some settings: its arm is trained, evaluated, and told to the study.
"""

from __future__ import annotations

import importlib.util
import json
import shlex
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import yaml
from rich.console import Console

from safe_wrappers.errors import ConfigurationError, RunStateError

from .config.load import parse_experiment, set_value
from .config.models import ExperimentConfig, SweepConfig
from .config.types import check_name
from .evaluation.evaluate import conditions, evaluate_run
from .evaluation.summary import number
from .experiment import check_training, summarize_experiment, write_cards
from .files import only_writer, say, write_rows, write_text
from .processes import Job, Progress, RunsFailedError
from .processes.parallel import run_jobs
from .run.model import whole_rollouts
from .run.training import train_run

if TYPE_CHECKING:
    import optuna

FOLDER: Final = "sweep"
"""In the experiment's folder: the study and the trials."""
CONFIG_FILE: Final = "config.yaml"
"""In a trial's folder: the config of an ordinary experiment."""
VIOLATIONS: Final = "violations_per_1000"
"""The constraint: 0 is kept."""
_FILTERED: Final = "filter_on"
RESULTS_FILE: Final = "sweep.csv"


def sweep_experiment(
    settings: Mapping[str, Any],
    config: Path,
    overrides: Sequence[str],
    console: Console,
    on: str | None = None,
) -> None:
    """Searches the settings of a config's `sweep`, or goes on with the search."""
    if importlib.util.find_spec("optuna") is None:
        raise ConfigurationError("optuna is not installed: pip install 'safe-wrappers[sweep]'")
    space = Space(settings)
    check_training(space.trial("base", {})[1])
    folder = space.experiment.folder / FOLDER
    with only_writer(folder):
        study = open_study(space, folder)
        while trials := next_trials(study, space):
            run_batch(space, trials, console, on)
            _write_results(study, list(space.config.parameters), folder)
    best, line = ranked(study)[0], "No trial came to an evaluation without violations: none is recommended."
    if is_kept(best):
        values = [f"{key}={best.params[key]}" for key in space.config.parameters]
        command = shlex.join(["safe-wrappers", "compare", str(config), *overrides, *values])
        line = f"Best: trial {best.number}, return {number(best.values[0])} at cost zero: {command}"
    say(console, f"{line}\nFiles: {folder / RESULTS_FILE}, and a folder for each trial beside it")


class Space:
    """The experiments that a sweep chooses from: the first arm with a filter, or the first one."""

    def __init__(self, settings: Mapping[str, Any]) -> None:
        self.experiment = parse_experiment(settings)
        if self.experiment.sweep is None:
            raise ConfigurationError(
                "config: 'sweep' is missing: it says what is searched, such as\n"
                "sweep: {trials: 20, parameters: {hyperparameters.learning_rate: {low: 1e-5, high: 1e-3, log: true}}}"
            )
        self.config: SweepConfig = self.experiment.sweep
        filtered = (arm.name for arm in self.experiment.arms if arm.filter.kind != "none")
        self.arm = next(filtered, self.experiment.arms[0].name)
        self._settings = {key: value for key, value in settings.items() if key != "sweep"}
        self.distributions = {key: self._checked(key, given) for key, given in self.config.parameters.items()}

    def trial(self, name: str, values: Mapping[str, Any]) -> tuple[dict[str, Any], ExperimentConfig]:
        """The experiment of a trial, as settings and checked; its only arm is the ranked one."""
        settings = deepcopy(self._settings)
        for key, value in values.items():
            set_value(settings, key, deepcopy(value))
        output = str(self.experiment.folder / FOLDER)
        settings |= {"arms": {self.arm: settings["arms"][self.arm]}, "name": name, "output": output}
        experiment = parse_experiment(settings)
        if _FILTERED not in conditions(experiment.arms[0], experiment.evaluation_filter):
            raise ConfigurationError(
                "trials are ranked by their return with the filter on, and there is no filter; give an arm or the"
                " evaluation one (evaluation: {filter: protect})."
            )
        return settings, experiment

    def identity(self) -> str:
        """What a study must agree on to go on: all that decides what is drawn and what a trial comes to."""
        experiment = self.trial("trial", {})[1]
        searched = {**self.config.plain(), "trials": None}  # which may be raised
        evaluation = experiment.evaluation.plain() | {"filter": experiment.evaluation_filter.plain()}
        of_arm = experiment.arms[0].fingerprint()
        return json.dumps([searched, of_arm, evaluation, experiment.seeds], sort_keys=True)

    def _checked(self, key: str, given: Mapping[str, Any]) -> optuna.distributions.BaseDistribution:
        from optuna import distributions

        place, words = f"sweep.parameters.{key}", [*key.split("."), ""]
        if words[0] == "arms":
            check_name(words[1], [arm.name for arm in self.experiment.arms], f"{place}: arms")
        if words[-2] == "total_steps":
            raise ConfigurationError(f"{place}: trials are compared at the same steps; leave it out.")
        ends = given.get("choices") or [given.get("low"), given.get("high")]
        integers = all(isinstance(value, int) for value in given.values())
        try:
            found: optuna.distributions.BaseDistribution
            if "choices" in given:  # as JSON, since a study keeps no lists and mappings
                found = distributions.CategoricalDistribution(
                    [json.dumps(value) for value in given["choices"]]
                )
            else:
                of = distributions.IntDistribution if integers else distributions.FloatDistribution
                found = of(**given)
            for value in ends:
                self.trial("trial", {key: value})
        except ConfigurationError as error:
            raise type(error)(f"{place}: {error}") from None
        except (TypeError, ValueError, ZeroDivisionError) as error:
            raise ConfigurationError(
                f"{place}: expected {{low: 0.1, high: 0.5}}, with log and step if wanted, or {{choices: [...]}}; got"
                f" {dict(given)}: {error}"
            ) from None
        return found


def open_study(space: Space, folder: Path) -> optuna.Study:
    """Creates the study, or goes on with it."""
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    storage = f"sqlite:///{(folder / 'study.db').resolve()}"
    study = optuna.create_study(storage=storage, study_name=FOLDER, direction="maximize", load_if_exists=True)
    ours = space.identity()
    if study.user_attrs.get("identity", ours) != ours:
        raise RunStateError(
            f"The study in {storage!r} is of another sweep. Choose another `name` or `output`, go back to its"
            " settings, or delete it with its trials."
        )
    study.set_user_attr("identity", ours)
    return study


def next_trials(study: optuna.Study, space: Space) -> list[optuna.Trial]:
    """The trials of the next batch, those first that a killed sweep left unfinished; none when all are done.

    What is drawn depends on the trials that are finished and on the trial's own number, so that a sweep that was
    killed tries the same as one that was not.
    """
    import optuna

    everything = study.get_trials(deepcopy=False)
    running = optuna.trial.TrialState.RUNNING
    left = [optuna.Trial(study, trial._trial_id) for trial in everything if trial.state == running]
    at_once, begun = space.config.at_once, len(everything)
    # Batches begin at multiples: a kill in the midst of one leaves it smaller, and here it is filled.
    ahead = -begun % at_once if left else at_once - begun % at_once
    for at in range(begun, min(begun + ahead, space.config.trials)):
        stream = np.random.SeedSequence((space.config.seed, at)).generate_state(1)[0]
        study.sampler = optuna.samplers.TPESampler(seed=int(stream) >> 1)
        left.append(study.ask(space.distributions))
    return left


def run_trial(experiment: ExperimentConfig, progress: Progress) -> None:
    """A trial's job: trains its arm with every seed and evaluates it, or goes on with that."""
    arm, quiet = experiment.arms[0], replace(progress, steps=lambda _: None)
    for seed in experiment.seeds:
        folder = experiment.run_folder(arm, seed)
        train_run(arm, seed, folder, progress)
        evaluate_run(arm, seed, folder, experiment.evaluation, experiment.evaluation_filter, quiet)


def run_batch(space: Space, trials: list[optuna.Trial], console: Console, on: str | None = None) -> None:
    """Runs trials side by side, each in one process, and tells their study what they came to."""
    from optuna.trial import TrialState

    jobs: list[Job] = []
    failed: set[str] = set()
    names = {f"trial_{trial.number:04d}": trial for trial in trials}
    for name, trial in names.items():
        values = {k: json.loads(v) if isinstance(v, str) else v for k, v in trial.params.items()}
        try:
            settings, experiment = space.trial(name, values)
            check_training(experiment)
        except ConfigurationError as error:
            say(console, f"{name}: {error}")
            failed.add(name)
            continue
        write_text(experiment.folder / CONFIG_FILE, yaml.safe_dump(settings, sort_keys=False))
        steps = whole_rollouts(experiment.arms[0])
        jobs.append(Job(name, steps, "steps", run_trial, (experiment,)))
    try:
        run_jobs(jobs, space.experiment.workers, console, "Trials", on=on)
    except RunsFailedError as error:
        say(console, str(error))
        failed |= error.names
    for name in failed:
        names[name].study.tell(names[name], state=TrialState.FAIL)
    for job in jobs:
        if job.name not in failed:
            _tell(names[job.name], *job.arguments)


def _tell(trial: optuna.Trial, experiment: ExperimentConfig) -> None:
    """Tells the study what a trial's evaluation with the filter on came to, as means over its seeds."""
    write_cards(experiment)
    rows = [row for row in summarize_experiment(experiment).per_seed if row["condition"] == _FILTERED]
    if not all(VIOLATIONS in row for row in rows):
        raise ConfigurationError(
            f"{experiment.name}: trials are ranked at cost zero, and the task reports no cost. Give it a judge:"
            " env.cost (module:function) or env.judge (constraints)."
        )
    trial.set_constraint(VIOLATIONS, float(np.mean([row[VIOLATIONS] for row in rows])))
    trial.study.tell(trial, float(np.mean([row["return"] for row in rows])))


def is_kept(trial: optuna.trial.FrozenTrial) -> bool:
    """Whether the trial was evaluated, and nothing was violated in it."""
    return bool(trial.state.name == "COMPLETE" and trial.constraints[VIOLATIONS] == 0.0)


def ranked(study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    """All trials, the best first.

    By return those in whose evaluation nothing was violated; then the others that were evaluated, by their
    violations; then the rest.
    """

    def place(trial: optuna.trial.FrozenTrial) -> tuple[float, ...]:
        if trial.state.name != "COMPLETE":
            return (np.inf, 0.0, trial.number)
        return (trial.constraints[VIOLATIONS], -trial.values[0], trial.number)

    return sorted(study.get_trials(deepcopy=False), key=place)


def _write_results(study: optuna.Study, parameters: Sequence[str], folder: Path) -> None:
    """Writes `sweep.csv`, a row per trial, the best first; what was not evaluated has empty cells."""
    rows = []
    for trial in ranked(study):
        row = {"trial": trial.number, "state": trial.state.name.lower(), **trial.params}
        if trial.state.name == "COMPLETE":
            state = "at cost zero" if is_kept(trial) else "in violation"
            row |= {"state": state, "return": trial.values[0], VIOLATIONS: trial.constraints[VIOLATIONS]}
        rows.append(row)
    write_rows(folder / RESULTS_FILE, ("trial", "state", "return", VIOLATIONS, *parameters), rows)
