"""Constraints as they were written before `Constraint` was a base class: objects with `rows(plant)`."""

import copy
import functools
import warnings
from typing import Any, Self

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.constraint import BoundConstraint, Constraint, Memory
from safe_wrappers.plants.plant import Plant


def duck_typed(given: Any) -> Constraint:
    """An object with `rows(plant)` as a constraint; warns that it should be a subclass.

    Raises:
        ConfigurationError: It is not one.
    """
    if isinstance(given, type) or not callable(getattr(given, "rows", None)):
        raise ConfigurationError(f"expected a constraint (a sw.Constraint) or the dict of one, got {given!r}")
    warnings.warn(
        f"{type(given).__name__} is a constraint by its methods alone, which is deprecated: make it a subclass of "
        "sw.Constraint whose bind(plant) returns a sw.BoundConstraint",
        DeprecationWarning,
        stacklevel=4,
    )
    return DuckTyped(given)


class DuckTyped(Constraint):
    """An object with `rows(plant)` and, if it has them, the other methods of its time; they take the plant first."""

    def __init__(self, given: Any) -> None:
        self.given = given
        self.promise = getattr(given, "promise", "best effort")
        self.measures_approach = hasattr(given, "approach")  # type: ignore[misc]
        self.margin, self.state_error = (getattr(given, name, 0.0) for name in ("margin", "state_error"))

    def bind(self, plant: Plant) -> "BoundDuckTyped":
        return BoundDuckTyped(self, plant)

    def widened(self, margin: float) -> Self:
        if not hasattr(self.given, "margin"):
            return super().widened(margin)
        wider = copy.deepcopy(self)
        wider.given.margin += margin
        return wider


_SAME = {name: name for name in ("check", "approach", "rows", "backup")}
_SAME |= {"cut": "linearize", "suggestions": "candidates"}
"""Methods of then that are those of today but for the plant, by their names then and now."""


class BoundDuckTyped(BoundConstraint):
    """A copy of such an object on a plant."""

    def __init__(self, spec: DuckTyped, plant: Plant) -> None:
        super().__init__(spec, plant)
        given = self._given = copy.deepcopy(spec.given)
        self.predicts = hasattr(given, "admits")
        self.has_value, self.has_backup = hasattr(given, "value"), hasattr(given, "backup")
        if hasattr(given, "report"):
            self.info_keys = ("*",)
        if hasattr(given, "bind"):
            given.bind(plant)
        for then, now in _SAME.items():
            if hasattr(given, then):
                setattr(self, now, functools.partial(getattr(given, then), plant))

    @property
    def scale(self) -> float:
        return float(getattr(self._given, "scale", 1.0))

    def start(self) -> Memory:
        if hasattr(self._given, "reset"):  # what lasts is the object's own
            self._given.reset()

    def value(self) -> Array:
        return np.asarray(self._given.value(self.plant)) if self.has_value else super().value()

    def slack(self, control: Array) -> float:
        if not self.predicts:
            return super().slack(control)
        if hasattr(self._given, "shortfall"):
            return -float(self._given.shortfall(self.plant, control))
        return 0.0 if self.admits(control) else -np.inf

    def admits(self, control: Array) -> bool:
        return bool(self._given.admits(self.plant, control)) if self.predicts else super().admits(control)

    def info(self, proposed: Array | None, executed: Array | None) -> dict[str, Any]:
        """Its report; after a reset of two zero actions."""
        if not hasattr(self._given, "report"):
            return {}
        zero = np.zeros(self.plant.lower.size)
        actions = (zero if action is None else action for action in (proposed, executed))
        found: dict[str, Any] = self._given.report(*actions)
        return found
