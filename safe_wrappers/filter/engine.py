"""SafetyFilter: proposals in, decisions out; no Gymnasium."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from safe_wrappers.control.projection import load_solvers
from safe_wrappers.errors import Array, ConfigurationError
from safe_wrappers.filter.bound import Bound
from safe_wrappers.filter.constraint import Constraint, Memory
from safe_wrappers.filter.fallback import Fallback, FallbackFunction
from safe_wrappers.filter.search import Decision, SafeActionSearch
from safe_wrappers.plants.plant import Plant


class SafetyFilter:
    """Constraints, bound to one plant, and the search for an admissible action.

    In an episode: `start`; then at every control step `observe`, `filter`, and `executed` with what was really sent.

    Args:
        plant: Bound to its env.
        constraints: Specifications; each is bound to the plant.
        fallback: "brake", "hold", "zero", or a function of the plant.
        low: Action box, shape (m,).
        high: Likewise.
        dtype: Of the actions; decisions are rounded to it before they are judged.
        search: How an admissible action is looked for.

    Attributes:
        constraints: As given.
        bound: The constraints on the plant, in their order.
        reporting: Those of them that write info keys of their own.
        memories: What each constraint remembers of the episode, in their order.
        last: The control that was executed last, shape (m,).
        margin: The smallest h of the observed state; inf if there is none, NaN if the state or an h is not a number.

    Raises:
        ConfigurationError: A constraint that does not fit the plant, or two that write the same info keys.
        UnknownNameError: No fallback of that name.
    """

    margin: float

    def __init__(
        self,
        plant: Plant,
        constraints: Sequence[Constraint],
        fallback: str | FallbackFunction,
        low: Array,
        high: Array,
        dtype: Any = np.float64,
        search: type[SafeActionSearch] = SafeActionSearch,
    ) -> None:
        self.plant, self.constraints = plant, constraints
        self._low, self._high = low, high
        self._loaded = False
        load_solvers()
        self.bound = [Bound(constraint, plant) for constraint in constraints]
        self.reporting = [c for c in self.bound if c.spec.info_keys]
        kinds = [type(c.spec).__name__ for c in self.reporting]
        for kind in kinds:
            if kinds.count(kind) > 1:
                twice = f"{kind} is in the list {kinds.count(kind)} times"
                raise ConfigurationError(f"{twice}, and both would write the same info keys; use one")
        self._search = search(plant, self.bound, Fallback(fallback, self.bound), low, high, dtype)

    def start(self) -> None:
        """Forget the episode, and take the state of the next one."""
        self.plant.executed(None)
        self.memories: list[Memory] = [{} for _ in self.bound]
        self.last = np.clip(np.zeros_like(self._low), self._low, self._high)
        self.observe()
        if not self._loaded and self.margin == self.margin:
            for c in self.bound:  # compiles what a step may need
                c.rows(), c.backup()
                if c.predicts:
                    c.slack(self.last)
            self._loaded = True

    def observe(self) -> None:
        """Take the env's present state, and `margin` from it."""
        plant = self.plant
        plant.observe()
        self.margin = math.nan
        for c in self.reporting:
            c.forget_report()
        state = float(np.add.reduce(plant.state))  # half the time of its method
        if state - state != 0.0:
            return
        lowest = math.inf
        for c, memory in zip(self.bound, self.memories, strict=True):
            c.observe(memory)
            if c.least != c.least:
                return
            lowest = min(lowest, c.least)
        self.margin = lowest

    def filter(self, boxed: Array | None) -> Decision:
        """The decision about a proposal inside the box, shape (m,), or about none: then the fallback proposes."""
        if self.margin != self.margin:
            return self._search.unreadable(self.last)
        if boxed is None:
            return self._search.without_proposal(self.last)
        return self._search.decide(boxed, self.last)

    def admits(self, control: Array) -> bool:
        """Whether a finite control inside the box, shape (m,), would be executed as it is in the observed state."""
        return self.margin == self.margin and all(c.admits(control) for c in self.bound)

    def executed(self, control: Array) -> None:
        """Remember what was sent, shape (m,), for the plant's delay, the constraints and a fallback that holds it."""
        self.last = control
        self.plant.executed(control)
        if self.margin == self.margin:
            for i, c in enumerate(self.bound):
                self.memories[i] = c.executed(control)

    def info(self) -> dict[str, Any]:
        """The info keys of the constraints' own about the observed state."""
        found: dict[str, Any] = {}
        for c in self.reporting:
            found |= c.spec.report
        return found
