"""`safe-wrappers sweep`: hyperparameters and filter parameters by Optuna, for the most return at cost zero.

A trial is an ordinary experiment with values of some settings: its arm is trained, given up where others were better,
evaluated, and told to the study.
"""

from __future__ import annotations

import importlib.util
import json
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import yaml
from rich.console import Console
from rich.table import Table

from safe_wrappers import info as keys
from safe_wrappers.errors import ConfigurationError, RunStateError, SafeWrappersError

from .config import ArmConfig, ExperimentConfig, ParameterConfig, SweepConfig, parse_experiment, set_value
from .config.types import check_name
from .evaluation.evaluate import conditions
from .evaluation.metrics import METRICS
from .evaluation.summary import episode_file, number
from .experiment import (
    check_training,
    evaluation_jobs,
    generations,
    summarize_experiment,
    training_jobs,
    write_cards,
)
from .files import only_writer, read_rows, write_rows, write_text
from .processes import Job, RunsFailedError
from .processes.parallel import run_jobs
from .run.stack import make_stack

if TYPE_CHECKING:
    import optuna

FOLDER: Final = "sweep"
"""In the experiment's folder: the study and the trials."""
CONFIG_FILE: Final = "config.yaml"
"""In a trial's folder: the config of an ordinary experiment."""
VIOLATIONS: Final = "violations_per_1000"
"""The constraint: 0 is kept."""
_FILTERED: Final = "filter_on"
_IDENTITY: Final = "identity"
_LOOK_S: Final = 5.0
_SHOWN: Final = 10


def sweep_experiment(
    settings: Mapping[str, Any],
    config: Path,
    overrides: Sequence[str],
    console: Console,
    on: str | None = None,
) -> None:
    """Searches the settings of a config's `sweep`, or goes on with the search.

    Args:
        settings: As `read_config` returned them.
        config: The file that they are from, for the command that is recommended.
        overrides: Those of the command line, for the same.
        console: Where progress and results are shown.
        on: Where trials run: None for this machine, or `ray` or `ray:ADDRESS`.

    Raises:
        ConfigurationError: Optuna is missing, a parameter is refused, or the task reports no cost.
        RunStateError: The study is another sweep's, or another process is at work on it.
        Interrupted: A signal came; the same command goes on.
    """
    if importlib.util.find_spec("optuna") is None:
        raise ConfigurationError("optuna is not installed: pip install 'safe-wrappers[sweep]'")
    space = Space(settings)
    check_training(space.trial("base", {})[1])
    _check_judged(space)
    folder = space.experiment.folder / FOLDER
    with only_writer(folder):
        study = open_study(space, folder)
        while trials := next_trials(study, space):
            numbers = ", ".join(str(trial.number) for trial in trials)
            console.print(f"Trial {numbers} of 0 to {space.config.trials - 1}", highlight=False)
            run_batch(space, trials, console, on)
            _write_results(study, list(space.config.parameters), folder)
    ranking = ranked(study)
    console.print(_table(ranking, space))
    best = ranking[0]
    if not is_kept(best):
        line = "No trial came to an evaluation without violations: none is recommended."
    else:
        values = [f"{key}={_yaml(best.params[key])}" for key in space.config.parameters]
        command = shlex.join(["safe-wrappers", "compare", str(config), *overrides, *values])
        line = f"Best: trial {best.number}, return {number(best.values[0])} at cost zero: {command}"
    console.print(line, highlight=False, markup=False, soft_wrap=True)
    console.print(f"Files: {folder}", soft_wrap=True, highlight=False)


class Space:
    """The experiments that a sweep chooses from.

    Args:
        settings: The config, as `read_config` returned it, with a section `sweep`.

    Raises:
        UnknownNameError: A parameter, or the sweep's arm, that does not exist.
        ConfigurationError: There is no such section or no filter, or a parameter has values that are refused or
            decide nothing.
    """

    def __init__(self, settings: Mapping[str, Any]) -> None:
        self.experiment = parse_experiment(settings)
        if self.experiment.sweep is None:
            raise ConfigurationError(
                "config: 'sweep' is missing: it says what is searched, such as\n"
                "sweep: {trials: 20, parameters: {hyperparameters.learning_rate: {low: 1e-5, high: 1e-3, log: true}}}"
            )
        self.config: SweepConfig = self.experiment.sweep
        arms = {arm.name: arm for arm in self.experiment.arms}
        filtered = (arm.name for arm in self.experiment.arms if arm.filter.kind != "none")
        name = self.config.arm or next(filtered, self.experiment.arms[0].name)
        self.arm = arms[check_name(name, arms, "sweep.arm")]
        self._settings = {key: value for key, value in settings.items() if key != "sweep"}
        for key, parameter in self.config.parameters.items():
            self._check(key, parameter)

    def trial(self, name: str, values: Mapping[str, Any]) -> tuple[dict[str, Any], ExperimentConfig]:
        """The experiment of a trial, as settings and checked: the ranked arm, and those that it begins with.

        Raises:
            ConfigurationError: The values do not go together.
        """
        settings = deepcopy(self._settings)
        for key, value in values.items():
            set_value(settings, key, deepcopy(value))
        # Those that are left out may have had the filter that others are evaluated with.
        first = next((arm for arm in self.experiment.arms if arm.filter.kind != "none"), None)
        evaluation = dict(settings.get("evaluation") or {})
        if first is not None and evaluation.get("filter") is None:
            evaluation["filter"] = settings["arms"][first.name]["filter"]
        arms: dict[str, Any] = {}
        arm: ArmConfig | None = self.arm
        while arm is not None:
            arms[arm.name] = settings["arms"][arm.name]
            arm = self.experiment.begins_with(arm)
        output = self.experiment.folder / FOLDER
        settings |= {"arms": arms, "evaluation": evaluation, "name": name, "output": str(output)}
        experiment = parse_experiment(settings)
        if _FILTERED not in conditions(experiment.arms[0], experiment.evaluation_filter):
            raise ConfigurationError(
                "trials are ranked by their return with the filter on, and there is no filter; give an arm or the"
                " evaluation one (evaluation: {filter: protect})."
            )
        return settings, experiment

    def identity(self) -> dict[str, Any]:
        """What a study must agree on to go on: all that decides what is drawn and what a trial comes to."""
        sweep = {"trials": None, "storage": None}  # these may change
        plain = {**self.config.plain(), **sweep, "arm": self.arm.name}
        plain["parameters"] = {key: parameter.plain() for key, parameter in self.config.parameters.items()}
        evaluation = self.experiment.evaluation
        plain["evaluation"] = [evaluation.seed, evaluation.episodes, self.experiment.seeds]
        found: dict[str, Any] = json.loads(json.dumps(plain | {"decides": self._decides({})}, sort_keys=True))
        return found

    def _decides(self, values: Mapping[str, Any]) -> list[Any]:
        """All that decides what the arms of a trial learn, and what they are evaluated with."""
        experiment = self.trial("trial", values)[1]
        used = conditions(experiment.arms[0], experiment.evaluation_filter)[_FILTERED]
        return [used.plain(), *(arm.fingerprint() for arm in experiment.arms)]

    def _check(self, key: str, parameter: ParameterConfig) -> None:
        place = f"sweep.parameters.{key}"
        first, *rest = key.split(".")
        if first == "arms":
            check_name(rest[0] if rest else "", [arm.name for arm in self.experiment.arms], f"{place}: arms")
        if key.split(".")[-1] == "total_steps":
            raise ConfigurationError(f"{place}: trials are compared at the same steps; leave it out.")
        ends = parameter.choices or [parameter.low, parameter.high]
        try:
            found = [self._decides({key: value}) for value in ends]
        except ConfigurationError as error:
            raise type(error)(f"{place}: {error}") from None
        if any(one == other for at, one in enumerate(found) for other in found[:at]):
            raise ConfigurationError(
                f"{place}: it changes nothing of what arm {self.arm.name!r} learns, or of the filter that it is"
                f" evaluated with (an arm's own value comes before one at the top). Tried: {ends}."
            )


def _check_judged(space: Space) -> None:
    """Refuses a task that does not say what a step costs: no return of it would be one at cost zero."""
    arm = space.arm
    used = conditions(arm, space.experiment.evaluation_filter)[_FILTERED]
    env = make_stack(arm.env, used, arm.learner.in_evaluation)
    env.action_space.seed(0)
    env.reset(seed=0)
    info = env.step(env.action_space.sample())[-1]
    env.close()
    if keys.COST not in info and keys.COST_SUBSTEP not in info:
        raise ConfigurationError(
            "sweep: trials are ranked at cost zero, and the task reports no cost. Give it a judge: env.cost"
            " (module:function) or env.judge (constraints)."
        )


def open_study(space: Space, folder: Path) -> optuna.Study:
    """Creates the study, or goes on with it.

    Raises:
        RunStateError: The study there is another sweep's.
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    storage = space.config.storage or f"sqlite:///{(folder / 'study.db').resolve()}"
    study = optuna.create_study(
        storage=storage, study_name=space.experiment.name, direction="maximize", load_if_exists=True
    )
    theirs, ours = study.user_attrs.get(_IDENTITY), space.identity()
    if theirs is None:
        study.set_user_attr(_IDENTITY, ours)
    elif theirs != ours:
        differ = [key for key in ours | theirs if theirs.get(key) != ours.get(key)]
        raise RunStateError(
            f"The study in {storage!r} is of another sweep (other {', '.join(differ)}). Choose another `name` or"
            " `output`, go back to its settings, or delete it with its trials."
        )
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
    return left + [study.ask() for _ in range(begun, min(begun + ahead, space.config.trials))]


def _draw(trial: optuna.Trial, config: SweepConfig) -> dict[str, Any]:
    """A value for each parameter; those that the trial has already stay."""
    import optuna

    stream = np.random.SeedSequence((config.seed, trial.number)).generate_state(1)[0]
    trial.study.sampler = optuna.samplers.TPESampler(seed=int(stream) >> 1)
    values = {}
    for key, parameter in config.parameters.items():
        if parameter.choices is not None:  # as text, since a study keeps no lists and mappings
            choices = [json.dumps(value) for value in parameter.choices]
            values[key] = json.loads(trial.suggest_categorical(key, choices))
            continue
        low, high, step = parameter.low, parameter.high, parameter.step
        assert low is not None and high is not None
        if parameter.integer:
            whole = 1 if step is None else int(step)
            values[key] = trial.suggest_int(key, int(low), int(high), step=whole, log=parameter.log)
        else:
            values[key] = trial.suggest_float(key, low, high, step=step, log=parameter.log)
    return values


@dataclass
class Attempt:
    """A trial at work."""

    trial: optuna.Trial
    experiment: ExperimentConfig
    batch: int
    """The number that its batch begins with."""
    reported: int = 0
    state: str = ""
    """PRUNED or FAIL, as soon as it is."""
    _looked_at: float = field(default_factory=time.monotonic)

    @property
    def arm(self) -> ArmConfig:
        """The one that is ranked."""
        return self.experiment.arms[0]

    def look(self) -> bool:
        """`report`, now and then; whether the trial is given up."""
        if time.monotonic() - self._looked_at >= _LOOK_S:
            self._looked_at = time.monotonic()
            self.report()
        return bool(self.state)

    def report(self, ended: bool = False) -> None:
        """Tells the study the returns of the intervals between checkpoints that are over, and asks it after each."""
        every, study = self.arm.checkpoint_every, self.trial.study
        folders = [self.experiment.run_folder(self.arm, seed) for seed in self.experiment.seeds]
        tables = [read_rows(episode_file(folder, "training")) for folder in folders]
        reached = min(int(rows[-1]["timesteps"]) if rows else 0 for rows in tables)
        until = self.arm.total_steps if ended else min(reached, self.arm.total_steps)
        while not self.state and (self.reported + 1) * every <= until:
            begin, end = self.reported * every, (self.reported + 1) * every
            returns = [[row["return"] for row in rows if begin < row["timesteps"] <= end] for rows in tables]
            self.reported += 1
            if all(returns):  # an episode may be longer than that
                if end not in study.get_trials(deepcopy=False)[self.trial.number].intermediate_values:
                    self.trial.report(float(np.mean([np.mean(of_seed) for of_seed in returns])), step=end)
                if is_worse_than_median(study, self.trial, self.batch):
                    self.state = "PRUNED"


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
    from optuna.trial import TrialState

    attempts: dict[str, Attempt] = {}
    for trial in trials:
        name = f"trial_{trial.number:04d}"
        try:
            settings, experiment = space.trial(name, _draw(trial, space.config))
            check_training(experiment)
        except ConfigurationError as error:
            console.print(f"{name}: {error}", highlight=False, markup=False, soft_wrap=True)
            trial.study.tell(trial, state=TrialState.FAIL)
            continue
        write_text(experiment.folder / CONFIG_FILE, yaml.safe_dump(settings, sort_keys=False))
        attempts[name] = Attempt(trial, experiment, trial.number - trial.number % space.config.at_once)

    def run(make: Callable[..., list[Job]], arms: Sequence[Any], title: str) -> None:
        jobs = [
            job
            for attempt, of_attempt in zip(attempts.values(), arms, strict=True)
            if not attempt.state
            for job in make(attempt.experiment, of_attempt, attempt.experiment.name)
        ]
        try:
            run_jobs(jobs, space.experiment.workers, console, title, _unwanted, on)
        except RunsFailedError as error:
            console.print(str(error), highlight=False, markup=False, soft_wrap=True)
            for job in error.names:
                attempts[job.split(" ")[0]].state = "FAIL"

    def _unwanted(job: str) -> bool:
        return attempts[job.split(" ")[0]].look()

    levels = zip_longest(*(generations(each.experiment) for each in attempts.values()), fillvalue=[])
    for level in levels:
        run(training_jobs, level, "Training of trials")
    for attempt in attempts.values():
        attempt.report(ended=True)
    run(evaluation_jobs, [each.experiment.arms for each in attempts.values()], "Evaluation of trials")
    for attempt in attempts.values():
        if attempt.state:
            attempt.trial.study.tell(attempt.trial, state=TrialState[attempt.state])
        else:
            _tell(attempt)


def _tell(attempt: Attempt) -> None:
    write_cards(attempt.experiment)
    rows = [
        row
        for row in summarize_experiment(attempt.experiment).per_seed
        if row["condition"] == _FILTERED and row["arm"] == attempt.arm.name
    ]
    if not all(VIOLATIONS in row for row in rows):
        raise SafeWrappersError(
            f"{attempt.experiment.name}: the task reported no cost in evaluation, so that nothing was judged."
        )
    attempt.trial.set_constraint(VIOLATIONS, float(np.mean([row[VIOLATIONS] for row in rows])))
    attempt.trial.study.tell(attempt.trial, float(np.mean([row["return"] for row in rows])))


def is_worse_than_median(study: optuna.Study, trial: optuna.Trial, before: int) -> bool:
    """Optuna's median rule, against trials in whose evaluation nothing was violated.

    Against all of them, reckless trials would set a bar that careful ones do not reach.

    Args:
        study: What was tried.
        trial: Which is in question.
        before: Only trials of lower numbers count: those of earlier batches, whichever ended first.
    """
    import optuna

    kept = optuna.create_study(direction="maximize")
    everything = study.get_trials(deepcopy=False)
    kept.add_trials([other for other in everything if other.number < before and is_kept(other)])
    return bool(optuna.pruners.MedianPruner().prune(kept, everything[trial.number]))


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
            return (2.0, trial.number)
        if is_kept(trial):
            return (0.0, -trial.values[0], trial.number)
        return (1.0, trial.constraints[VIOLATIONS], -trial.values[0], trial.number)

    return sorted(study.get_trials(deepcopy=False), key=place)


def _state(trial: optuna.trial.FrozenTrial) -> str:
    if trial.state.name == "COMPLETE":
        return "at cost zero" if is_kept(trial) else "in violation"
    return str(trial.state.name.lower())


def _write_results(study: optuna.Study, parameters: Sequence[str], folder: Path) -> None:
    """Writes `sweep.csv`, a row per trial in their order; what was not evaluated has empty cells."""
    rows = []
    for trial in study.get_trials(deepcopy=False):
        row = {"trial": trial.number, "state": _state(trial), **trial.params}
        if trial.state.name == "COMPLETE":
            row |= {"return": trial.values[0], VIOLATIONS: trial.constraints[VIOLATIONS]}
        rows.append(row)
    write_rows(folder / "sweep.csv", ("trial", "state", "return", VIOLATIONS, *parameters), rows)


def _table(trials: Sequence[optuna.trial.FrozenTrial], space: Space) -> Table:
    """The best trials."""
    shown, parameters = trials[:_SHOWN], list(space.config.parameters)
    table = Table(title=f"{space.experiment.name}: the best {len(shown)} of {len(trials)} trials")
    for heading in ("trial", METRICS["return"], METRICS[VIOLATIONS], "", *parameters):
        table.add_column(heading, justify="right")
    for trial in shown:
        came_to = ["-", "-"]
        if trial.state.name == "COMPLETE":
            came_to = [number(trial.values[0]), number(trial.constraints[VIOLATIONS])]
        values = map(trial.params.get, parameters)
        told = [number(value) if isinstance(value, float) else str(value) for value in values]
        table.add_row(str(trial.number), *came_to, _state(trial), *told)
    return table


def _yaml(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
