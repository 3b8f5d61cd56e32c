"""`safe-wrappers sweep CONFIG`: trial after trial, until there are as many as the config asks for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from safe_wrappers import info as keys
from safe_wrappers.errors import ConfigurationError

from ..evaluation.evaluate import conditions
from ..experiment import check_training
from ..processes.lock import only_writer
from ..run.stack import make_stack
from .batch import run_batch
from .results import results_table, verdict, write_results
from .space import FILTERED, FOLDER, Space
from .study import check_optuna, next_trials, open_study


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
    check_optuna()
    space = Space(settings)
    base = space.trial("base", {})[1]
    check_training(base)
    _check_judged(space)
    folder = space.experiment.folder / FOLDER
    names = list(space.config.parameters)
    with only_writer(folder):
        study = open_study(space, folder)
        while trials := next_trials(study, space, folder):
            numbers = ", ".join(str(trial.number) for trial in trials)
            console.print(f"Trial {numbers} of 0 to {space.config.trials - 1}", highlight=False)
            run_batch(space, trials, console, on)
            write_results(study, names, folder)
        path = write_results(study, names, folder)
    console.print(results_table(study, names, space.experiment.name))
    console.print(verdict(study, names, config, overrides), highlight=False, markup=False, soft_wrap=True)
    console.print(f"Files: {path.parent}", soft_wrap=True, highlight=False)


def _check_judged(space: Space) -> None:
    """Refuses a task that does not say what a step costs: no return of it would be one at cost zero."""
    arm = space.arm
    used = conditions(arm, space.experiment.evaluation_filter)[FILTERED]
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
