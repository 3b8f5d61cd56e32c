"""From a boxed proposal to the control that is executed: rows, one projection, prediction, fallback."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.filter.constraint import Constraint
from safe_wrappers.filter.fallback import Fallback
from safe_wrappers.filter.projection import Projection, Status, keeps_rows, project_unchecked
from safe_wrappers.plants.mujoco.plant import MujocoPlant
from safe_wrappers.plants.plant import Plant

Array = NDArray[np.float64]

_CUTS = 6
"""How often a refused control is answered by linearising anew about it."""
_OVERSHOOTS = (0.02, 0.1)
"""Shares by which a refused correction is made larger where no constraint can linearise anew."""
_BLENDS = (0.1, 0.25, 0.5, 0.75)
"""How far a refused control is moved towards the stopping control, step by step."""


@dataclass(slots=True)
class Decision:
    """What to execute and how it was found.

    Attributes:
        control: Shape (m,), finite, inside the box.
        fallback: The fallback chose it.
        infeasible: Nothing that was tried is admitted by every constraint.
        changed: It is not the proposal.
        rows: The half-spaces that it satisfies, for rounding.
        refused: Which constraints did not admit the proposal, shape (number of constraints,); None: none did.
    """

    control: Array
    fallback: bool = False
    infeasible: bool = False
    changed: bool = True
    rows: tuple[Array, Array] = (np.zeros((0, 0)), np.zeros(0))
    refused: NDArray[np.bool_] | None = None


class Decider:
    """Finds the closest admissible control, or falls back.

    Args:
        plant: Bound and observed by the caller.
        constraints: All of them.
        fallback: Chooses when nothing admissible is found.
        solver: For the projection.
        low: Action box, shape (m,).
        high: Likewise.
    """

    def __init__(
        self,
        plant: Plant,
        constraints: list[Constraint],
        fallback: Fallback,
        solver: str,
        low: Array,
        high: Array,
    ) -> None:
        self._plant, self._fallback, self._solver, self._low, self._high = plant, fallback, solver, low, high
        self._constraints = constraints
        self._certifying: list[Any] = [c for c in constraints if hasattr(c, "admits")]
        self._rows_only: list[Constraint] = [c for c in constraints if not hasattr(c, "admits")]
        self._suggesting: list[Any] = [c for c in constraints if hasattr(c, "suggestions")]
        self._cutting: list[Any] = [c for c in self._certifying if hasattr(c, "cut")]
        self._backups: list[Any] = [c for c in constraints if hasattr(c, "backup")]
        # A MujocoPlant's bounds are the action space's; others may be narrower, at some states only.
        self._narrower = not isinstance(plant, MujocoPlant)

    def decide(self, boxed: Array, last: Array) -> Decision:
        """The executed control for a proposal inside the box; `last` is what was executed before."""
        nominal = np.clip(boxed, self._plant.lower, self._plant.upper) if self._narrower else boxed
        self._tried: list[Array] = []
        decision = self._decide(nominal, last)
        if decision.changed:
            decision.refused = self._refusing(nominal)
        if self._narrower:
            decision.changed |= bool((nominal != boxed).any())
        return decision

    def _refusing(self, boxed: Array) -> NDArray[np.bool_]:
        """Which constraints do not admit a control: those that predict by their prediction, others by rows."""
        refused = np.zeros(len(self._constraints), dtype=bool)
        for i, constraint in enumerate(self._constraints):
            admits = getattr(constraint, "admits", None)
            if admits is not None:
                refused[i] = not admits(self._plant, boxed)
            else:
                rows = constraint.rows(self._plant)
                # Negated, so that a row that is not a number counts as refusing.
                refused[i] = not bool((rows.normals @ boxed <= rows.offsets).all())
        return refused

    def _decide(self, boxed: Array, last: Array) -> Decision:
        refused = bool(self._certifying) and not self._admitted(boxed)
        strict = self._rows(self._rows_only)
        if not refused:
            if not strict[1].size:
                return Decision(boxed, changed=False)
            result, control = self._project(boxed, *strict)
            if result.status is Status.INACTIVE and control is boxed:
                return Decision(boxed, changed=False)
            if result.status in (Status.INFEASIBLE, Status.FAILED):
                return self._fall_back(control, last, infeasible=result.status is Status.INFEASIBLE)
            if not self._certifying or self._admitted(control):
                return Decision(control, changed=bool((control != boxed).any()), rows=strict)
        for constraint in self._suggesting if refused else ():
            for control in constraint.suggestions(self._plant, boxed):
                if self._keeps(control, strict):
                    return Decision(control)
        return self._search(boxed, strict, last)

    def _search(self, boxed: Array, strict: tuple[Array, Array], last: Array) -> Decision:
        """Project on the rows of all constraints; where prediction refuses the answer, look closer."""
        rows = _joined(strict, self._rows(self._certifying))
        result, control = self._project(boxed, *rows)
        if result.status is Status.FAILED:
            return self._fall_back(control, last, infeasible=False)
        if result.status is Status.INFEASIBLE:
            # Linear rows of constraints that predict are only a guess: what counts is the others' rows.
            rows = strict
            result, control = self._project(boxed, *rows)
            if result.status in (Status.INFEASIBLE, Status.FAILED):
                return self._fall_back(control, last, infeasible=result.status is Status.INFEASIBLE)
        for _ in range(_CUTS):
            if self._admitted(control):
                return Decision(control, changed=bool((control != boxed).any()), rows=rows)
            cuts = self._cuts(control)
            if not cuts[1].size:
                break
            rows = _joined(rows, cuts)
            result, control = self._project(boxed, *rows)
            if result.status is Status.FAILED:
                break
        else:
            if self._keeps(control, strict):
                return Decision(control)
        return self._nearby(boxed, control, rows, strict, last)

    def _nearby(
        self,
        boxed: Array,
        control: Array,
        rows: tuple[Array, Array],
        strict: tuple[Array, Array],
        last: Array,
    ) -> Decision:
        """A little more of the same correction, a proved stopping control, or something in between."""
        excess = np.maximum(rows[0] @ boxed - rows[1], 0.0)
        for share in _OVERSHOOTS if excess.any() else ():
            result, more = self._project(boxed, rows[0], rows[1] - share * excess)
            if result.status is Status.PROJECTED and self._admitted(more):
                return Decision(more, rows=rows)
        stops = [np.clip(c.backup(self._plant), self._low, self._high) for c in self._backups]
        safe = next((stop for stop in stops if self._keeps(stop, strict)), None)
        target = safe if safe is not None else self._fallback_control(control, last)
        for share in _BLENDS:
            blend = control + share * (target - control)
            if self._keeps(blend, strict):
                return Decision(blend)
        for j in range(target.size):
            mixed = target.copy()
            mixed[j] = control[j]
            if self._keeps(mixed, strict):
                return Decision(mixed)
        if safe is not None:
            return Decision(safe)
        if self._keeps(target, strict):
            return Decision(target, fallback=True)
        return Decision(self._least_failing(target, strict), fallback=True, infeasible=True)

    def _least_failing(self, target: Array, strict: tuple[Array, Array]) -> Array:
        """Of all that was tried, the control whose forecast fails least; the fallback's own if it is not "brake"."""
        if not (self._fallback.brakes and all(hasattr(c, "shortfall") for c in self._certifying)):
            return target
        kept = [u for u in self._tried if self._within(u, strict)]

        def failing(control: Array) -> float:
            return max(float(c.shortfall(self._plant, control) / c.scale) for c in self._certifying)

        return min([target, *kept], key=failing)

    def _fall_back(self, least: Array, last: Array, infeasible: bool) -> Decision:
        return Decision(self._fallback_control(least, last), fallback=True, infeasible=infeasible)

    def _fallback_control(self, least: Array | None, last: Array) -> Array:
        return self._fallback(self._plant, last, self._low, self._high, least)

    def without_proposal(self, last: Array) -> Decision:
        """The fallback's control, filtered like a policy's: for a proposal that is not finite."""
        decision = self.decide(self._fallback_control(None, last), last)
        decision.fallback = decision.changed = True
        decision.refused = None  # of the fallback's control; there was no proposal to refuse
        return decision

    def unreadable(self, last: Array) -> Decision:
        """The fallback alone: a state or a barrier that is not a number says nothing about any control."""
        control = self._fallback(self._plant, last, self._low, self._high, None, readable=False)
        return Decision(control, fallback=True)

    def _admitted(self, control: Array) -> bool:
        admitted = all(c.admits(self._plant, control) for c in self._certifying)
        if not admitted:
            self._tried.append(control)
        return admitted

    def _keeps(self, control: Array, strict: tuple[Array, Array]) -> bool:
        return self._within(control, strict) and self._admitted(control)

    def _within(self, control: Array, strict: tuple[Array, Array]) -> bool:
        return not strict[1].size or keeps_rows(control, *strict, self._low, self._high)

    def _rows(self, asked: list[Any]) -> tuple[Array, Array]:
        parts = [c.rows(self._plant) for c in asked]
        if len(parts) == 1:
            return parts[0].normals, parts[0].offsets
        if not parts:
            return np.zeros((0, self._low.size)), np.zeros(0)
        return np.concatenate([p.normals for p in parts]), np.concatenate([p.offsets for p in parts])

    def _cuts(self, control: Array) -> tuple[Array, Array]:
        parts = [c.cut(self._plant, control) for c in self._cutting if not c.admits(self._plant, control)]
        if not parts:
            return np.zeros((0, self._low.size)), np.zeros(0)
        return np.concatenate([p.normals for p in parts]), np.concatenate([p.offsets for p in parts])

    def _project(self, boxed: Array, normals: Array, offsets: Array) -> tuple[Projection, Array]:
        lower, upper = self._plant.lower, self._plant.upper
        low, high = np.maximum(self._low, lower), np.minimum(self._high, upper)
        nominal = boxed if bool(((boxed >= low) & (boxed <= high)).all()) else np.clip(boxed, low, high)
        acting = getattr(self._plant, "acting_range", None)
        if acting is None or acting[0] is lower:
            result = project_unchecked(nominal, normals, offsets, low, high, self._solver)
            return result, result.control
        least, most = np.clip(acting[0], low, high), np.clip(acting[1], low, high)
        # Measured in shares of what acts: a control that saturates early must not look cheap to change.
        force = np.clip(nominal, least, most)
        reach, box = most - least, high - low
        unit = np.where((reach > 0.0) & np.isfinite(box), reach / np.where(box > 0.0, box, 1.0), 1.0)
        result = project_unchecked(
            force / unit, normals * unit, offsets, least / unit, most / unit, self._solver
        )
        if result.status is Status.INACTIVE:
            return result, nominal
        # A component that saturates as the policy's did stays the policy's: the force is the same.
        return result, np.where(result.control == force / unit, nominal, result.control * unit)


def _joined(first: tuple[Array, Array], second: tuple[Array, Array]) -> tuple[Array, Array]:
    if not first[1].size:
        return second
    if not second[1].size:
        return first
    return np.concatenate([first[0], second[0]]), np.concatenate([first[1], second[1]])
