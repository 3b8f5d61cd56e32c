"""What a sweep searches: each parameter is a setting of the config, a trial an experiment with values of them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from copy import deepcopy
from typing import TYPE_CHECKING, Any, Final

from safe_wrappers.errors import ConfigurationError

from ..config import ArmConfig, ExperimentConfig, FilterConfig, ParameterConfig, SweepConfig, parse_experiment
from ..config.file import set_value
from ..config.names import check_name
from ..evaluation.evaluate import conditions

if TYPE_CHECKING:
    import optuna

FOLDER: Final = "sweep"
"""In the experiment's folder: the study and the trials."""
FILTERED: Final = "filter_on"


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
        self.arm = self._ranked()
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
            set_value(settings, key, deepcopy(value), "config")
        arms = {arm: settings["arms"][arm] for arm in self.trained}
        # Those that are left out may have had the filter that others are evaluated with.
        first = next((arm for arm in self.experiment.arms if arm.filter.kind != "none"), None)
        evaluation = dict(settings.get("evaluation") or {})
        if first is not None and evaluation.get("filter") is None:
            evaluation["filter"] = settings["arms"][first.name]["filter"]
        output = self.experiment.folder / FOLDER
        settings |= {"arms": arms, "evaluation": evaluation, "name": name, "output": str(output)}
        experiment = parse_experiment(settings)
        self._refuse_unfiltered(experiment, self.arm.name)
        return settings, experiment

    @property
    def trained(self) -> list[str]:
        """The names of the arms that a trial trains, the ranked one first."""
        chain: list[str] = []
        arm: ArmConfig | None = self.arm
        while arm is not None:
            chain.append(arm.name)
            arm = self.experiment.begins_with(arm)
        return chain

    @property
    def identity(self) -> dict[str, Any]:
        """What a study must agree on to go on: all that decides what is drawn and what a trial comes to."""
        parameters = {key: vars(parameter) for key, parameter in self.config.parameters.items()}
        plain = {
            "arm": self.arm.name,
            "seed": self.config.seed,
            "at_once": self.config.at_once,
            "parameters": {
                key: {name: value for name, value in fields.items() if not name.startswith("_")}
                for key, fields in parameters.items()
            },
            "seeds": self.experiment.seeds,
            "evaluation": {
                "seed": self.experiment.evaluation.seed,
                "episodes": self.experiment.evaluation.episodes,
            },
            "settings": _decides(self.experiment, self.trained),
        }
        read: dict[str, Any] = json.loads(json.dumps(plain, sort_keys=True))
        return read

    def _ranked(self) -> ArmConfig:
        arms = {arm.name: arm for arm in self.experiment.arms}
        name = self.config.arm
        if name is None:
            filtered = (arm.name for arm in self.experiment.arms if arm.filter.kind != "none")
            name = next(filtered, self.experiment.arms[0].name)
        arm = arms[check_name(name, tuple(arms), "sweep.arm")]
        self._refuse_unfiltered(self.experiment, arm.name)
        return arm

    @staticmethod
    def _refuse_unfiltered(experiment: ExperimentConfig, name: str) -> None:
        arm = next(arm for arm in experiment.arms if arm.name == name)
        if FILTERED not in conditions(arm, experiment.evaluation_filter):
            raise ConfigurationError(
                "trials are ranked by their return with the filter on, and there is no filter; give an arm or the"
                " evaluation one (evaluation: {filter: protect})."
            )

    def _check(self, key: str, parameter: ParameterConfig) -> None:
        place = f"sweep.parameters.{key}"
        if key.split(".")[0] == "arms":
            arms = [arm.name for arm in self.experiment.arms]
            check_name(key.split(".")[1] if "." in key else "", arms, f"{place}: arms")
        if key.split(".")[-1] == "total_steps":
            raise ConfigurationError(f"{place}: trials are compared at the same steps; leave it out.")
        ends = parameter.choices or [parameter.low, parameter.high]
        try:
            found = [_decides(self.trial("trial", {key: value})[1], self.trained) for value in ends]
        except ConfigurationError as error:
            raise type(error)(f"{place}: {error}") from None
        if any(one == other for at, one in enumerate(found) for other in found[:at]):
            raise ConfigurationError(
                f"{place}: it changes nothing of what arm {self.arm.name!r} learns, or of the filter that it is"
                f" evaluated with (an arm's own value comes before one at the top). Tried: {ends}."
            )


def draw(trial: optuna.Trial, parameters: Mapping[str, ParameterConfig]) -> dict[str, Any]:
    """A value for each parameter; those that the trial has already stay."""
    return {key: _draw(trial, key, parameter) for key, parameter in parameters.items()}


def _draw(trial: optuna.Trial, key: str, parameter: ParameterConfig) -> Any:
    if parameter.choices is not None:  # as text, since a study keeps no lists and mappings
        return json.loads(trial.suggest_categorical(key, [json.dumps(value) for value in parameter.choices]))
    assert parameter.low is not None and parameter.high is not None
    if parameter.integer:
        step = 1 if parameter.step is None else int(parameter.step)
        return trial.suggest_int(key, int(parameter.low), int(parameter.high), step=step, log=parameter.log)
    return trial.suggest_float(key, parameter.low, parameter.high, step=parameter.step, log=parameter.log)


def _decides(experiment: ExperimentConfig, arms: list[str]) -> dict[str, Any]:
    """All of an experiment that decides what these arms learn, and what they are evaluated with."""
    return {
        arm.name: {
            "config": arm.fingerprint(),
            FILTERED: conditions(arm, experiment.evaluation_filter).get(FILTERED, FilterConfig()).plain(),
        }
        for arm in experiment.arms
        if arm.name in arms
    }
