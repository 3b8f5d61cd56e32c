"""Constraints as they were written before `Constraint` was a base class: objects with `rows(plant)`."""

import copy
import warnings
from collections.abc import Iterable
from typing import Any, Self

import numpy as np

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.constraint import Array, BoundConstraint, Constraint, HalfSpaces, Memory
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


class BoundDuckTyped(BoundConstraint):
    """A copy of such an object on a plant."""

    def __init__(self, spec: DuckTyped, plant: Plant) -> None:
        super().__init__(spec, plant)
        self._given = copy.deepcopy(spec.given)
        self.predicts = hasattr(self._given, "admits")
        self.has_value, self.has_backup = (hasattr(self._given, name) for name in ("value", "backup"))
        if hasattr(self._given, "report"):
            self.info_keys = ("*",)
        if hasattr(self._given, "bind"):
            self._given.bind(plant)

    def _ask(self, method: str, default: Any, *arguments: Any) -> Any:
        known = getattr(self._given, method, None)
        return default if known is None else known(*arguments)

    @property
    def scale(self) -> float:
        return float(getattr(self._given, "scale", 1.0))

    def start(self) -> Memory:
        self._ask("reset", None)

    def check(self) -> None:
        self._ask("check", None, self.plant)

    def value(self) -> Array:
        return np.asarray(self._ask("value", np.zeros(0), self.plant))

    def approach(self) -> tuple[Array, Array] | None:
        found: tuple[Array, Array] | None = self._ask("approach", None, self.plant)
        return found

    def rows(self) -> HalfSpaces:
        rows: HalfSpaces = self._given.rows(self.plant)
        return rows

    def slack(self, control: Array) -> float:
        if not self.predicts:
            return super().slack(control)
        if hasattr(self._given, "shortfall"):
            return -float(self._given.shortfall(self.plant, control))
        return 0.0 if self.admits(control) else -np.inf

    def admits(self, control: Array) -> bool:
        return bool(self._given.admits(self.plant, control)) if self.predicts else super().admits(control)

    def linearize(self, control: Array) -> HalfSpaces:
        rows: HalfSpaces = self._ask("cut", super().linearize(control), self.plant, control)
        return rows

    def candidates(self, control: Array) -> Iterable[Array]:
        every: Iterable[Array] = self._ask("suggestions", (), self.plant, control)
        return every

    def backup(self) -> Array | None:
        control: Array | None = self._ask("backup", None, self.plant)
        return control

    def info(self, proposed: Array | None, executed: Array | None) -> dict[str, Any]:
        zero = np.zeros(self.plant.lower.size)
        both = [zero if action is None else action for action in (proposed, executed)]
        found: dict[str, Any] = self._ask("report", {}, *both)
        return found
