"""SweepConfig: which settings a sweep searches, and how."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, StrictBool, StrictInt, model_validator
from pydantic.dataclasses import dataclass

from safe_wrappers.errors import ConfigurationError

from .section import Section
from .types import Count, NonNegative, Number

Bound = Number | StrictInt


@dataclass(frozen=True)
class ParameterConfig(Section):
    """What one setting may be: a range, `{low: 1e-5, high: 1e-3, log: true}`, or `{choices: [...]}`."""

    low: Bound | None = None
    """Smallest value. Two integers give integers."""
    high: Bound | None = None
    """Largest value, itself included."""
    log: StrictBool = False
    """Drawn by its logarithm."""
    step: Annotated[Number, Field(gt=0)] | None = None
    """Only `low` plus multiples of it."""
    choices: list[Any] | None = None
    """Instead of a range: the values that it may have, in YAML of any type."""

    @model_validator(mode="after")
    def _is_a_range_or_a_list(self) -> ParameterConfig:
        if self.choices is not None:
            if (self.low, self.high, self.step, self.log) != (None, None, None, False):
                raise ConfigurationError("expected low and high, or choices; got both.")
            if len(self.choices) < 2 or any(self.choices.count(value) > 1 for value in self.choices):
                raise ConfigurationError(
                    f"choices: expected two or more different values, got {self.choices}."
                )
            return self
        if self.low is None or self.high is None:
            raise ConfigurationError("expected low and high ({low: 0.1, high: 0.5}), or choices.")
        if not self.low < self.high:
            raise ConfigurationError(
                f"the range is empty: low is {self.low}, high is {self.high}; low must be below high."
            )
        if self.log and (self.low <= 0 or self.step is not None):
            raise ConfigurationError(
                f"log needs low above 0 and no step; low is {self.low}, step is {self.step}."
            )
        if self.step is not None and self.integer and not float(self.step).is_integer():
            raise ConfigurationError(
                f"step: low and high are integers, so that step must be one, got {self.step}."
            )
        return self

    @property
    def integer(self) -> bool:
        """Whether whole numbers are drawn."""
        return isinstance(self.low, int) and isinstance(self.high, int)


@dataclass(frozen=True)
class SweepConfig(Section):
    """What `safe-wrappers sweep` searches; other commands leave it alone."""

    parameters: Annotated[dict[str, ParameterConfig], Field(min_length=1)]
    """The settings that are searched, by the keys of the command line (`hyperparameters.learning_rate`,
    `arms.filtered.filter.protect.margin`), each with its range or its choices."""
    trials: Count = 20
    """How many are tried. May be raised later: the same command goes on."""
    at_once: Count = 1
    """Trials that are drawn together and run at the same time. More use more cores or nodes, and know less of each
    other. With `seed` it decides what is drawn, on any machine."""
    arm: str | None = None
    """The arm that is trained and ranked, after those that it begins with; by default the first one with a filter."""
    seed: NonNegative = 0
    """Of the search."""
    storage: str | None = None
    """URL of the database that keeps the study, as SQLAlchemy has it (`postgresql://...`, `sqlite:///...`); by
    default `sweep/study.db` in the experiment's folder."""
