"""The study of a sweep: what was tried so far, in a database, and what to try next."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from safe_wrappers.errors import ConfigurationError, RunStateError

from .space import Space, draw

if TYPE_CHECKING:
    import optuna

STUDY_FILE: Final = "study.db"
VIOLATIONS: Final = "violations_per_1000"
"""The constraint: 0 is kept."""
_IDENTITY: Final = "identity"
_FOLDER: Final = "folder"


def check_optuna() -> None:
    """Refuses to search without Optuna.

    Raises:
        ConfigurationError: It is not installed; says how to install it.
    """
    if importlib.util.find_spec("optuna") is None:
        raise ConfigurationError("optuna is not installed: pip install 'safe-wrappers[sweep]'")


def open_study(space: Space, folder: Path) -> optuna.Study:
    """Creates the study, or goes on with it.

    Args:
        space: What is searched.
        folder: The sweep's own folder.

    Raises:
        ConfigurationError: There is no such storage.
        RunStateError: The study there is another sweep's; shows what differs.
    """
    import optuna
    from sqlalchemy.exc import SQLAlchemyError

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    storage = space.config.storage or f"sqlite:///{(folder / STUDY_FILE).resolve()}"
    try:
        study = optuna.create_study(
            storage=storage, study_name=space.experiment.name, direction="maximize", load_if_exists=True
        )
    except (SQLAlchemyError, ImportError) as error:
        raise ConfigurationError(
            f"sweep.storage: {storage!r} cannot be opened ({str(error).splitlines()[0]}); expected a URL as"
            " SQLAlchemy has it, such as postgresql://user@host/studies with its driver installed, or sqlite:////folder/studies.db"
        ) from error
    theirs, ours = study.user_attrs.get(_IDENTITY), space.identity
    if theirs is None:
        study.set_user_attr(_IDENTITY, ours)
    elif theirs != ours:
        lines = [f"  {line}" for line in _differences(theirs, ours)]
        raise RunStateError(
            f"The study in {storage!r} is of another sweep:\n" + "\n".join(lines) + "\n"
            "Choose another `name` or `output`, go back to its settings, or delete it with its trials."
        )
    return study


def next_trials(study: optuna.Study, space: Space, folder: Path) -> list[optuna.Trial]:
    """The trials of the next batch, those first that a killed sweep left unfinished; none when all are done.

    What is drawn depends on the trials that are finished and on the trial's own number, so that a sweep that was
    killed tries the same as one that was not.

    Args:
        study: What was tried.
        space: What is searched.
        folder: The sweep's own folder; trials of others in the same database are left alone.
    """
    import optuna

    everything = study.get_trials(deepcopy=False)
    here = str(folder.resolve())
    left = [
        optuna.Trial(study, trial._trial_id)
        for trial in everything
        if trial.state == optuna.trial.TrialState.RUNNING and trial.user_attrs.get(_FOLDER, here) == here
    ]
    at_once, begun = space.config.at_once, len(everything)
    # Batches begin at multiples: a kill in the midst of one leaves it smaller, and here it is filled.
    ahead = -begun % at_once if left else at_once - begun % at_once
    left += [study.ask() for _ in range(begun, min(begun + ahead, space.config.trials))]
    for trial in left:
        trial.set_user_attr(_FOLDER, here)
    return left


def values_of(space: Space, trial: optuna.Trial) -> dict[str, Any]:
    """The values of a trial's parameters: drawn, or those that it has already."""
    import optuna

    stream = np.random.SeedSequence((space.config.seed, trial.number)).generate_state(1)[0]
    trial.study.sampler = optuna.samplers.TPESampler(seed=int(stream) >> 1)
    return draw(trial, space.config.parameters)


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


def _differences(theirs: Mapping[str, Any], ours: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    for key in sorted(theirs.keys() | ours.keys()):
        there, here = theirs.get(key, "unset"), ours.get(key, "unset")
        if isinstance(there, dict) and isinstance(here, dict):
            yield from _differences(there, here, f"{prefix}{key}.")
        elif there != here:
            yield f"{prefix}{key}: {there!r} in the study, {here!r} in the config"
