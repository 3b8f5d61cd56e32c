"""From a boxed proposal to an admissible action: a ladder of stages, the cheapest first.

Each stage is a method that returns the control it has found, or None; `Decision.stage` names the one that answered.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.control.projection import (
    Projection,
    Status,
    cast_inside,
    keeps_rows,
    project_unchecked,
)
from safe_wrappers.errors import Array
from safe_wrappers.filter.bound import Bound
from safe_wrappers.filter.constraint import HalfSpaces
from safe_wrappers.filter.fallback import Fallback
from safe_wrappers.plants.plant import Plant

Rows = tuple[Array, Array]
"""`normals @ u <= offsets`: shapes (k, m) and (k,)."""

_LINEARIZATIONS = 6  # how often a refused control is answered by tangents that are not provisional
_TRIES = 3  # to shorten an admitted correction
_WORTH = 0.05  # share of a correction that a try must promise to take off
_BEYOND = 0.05  # aim of a try beyond the boundary, as a share of the proposal's violation
_OVERSHOOTS = (0.02, 0.1)  # shares by which a refused correction is made larger
_BLENDS = (0.1, 0.25, 0.5, 0.75)  # shares of the way from a refused control to the backup control


class Stage(IntEnum):
    """What found the executed action."""

    PROPOSAL = 0
    """Every constraint admits the proposal; it is executed bit for bit."""
    ROWS = 1
    """Projection on the constraints' rows."""
    CANDIDATE = 2
    """A constraint's own candidate."""
    RELINEARIZED = 3
    """Projection on rows that were linearised anew about refused controls."""
    OVERSHOOT = 4
    """The same correction, a little larger."""
    BLEND = 5
    """A refused control moved towards a backup control or the fallback."""
    BACKUP = 6
    """A constraint's backup control."""
    FALLBACK = 7
    """The fallback, admitted or not (`infeasible` says which)."""
    LEAST_VIOLATION = 8
    """Of all that was tried, and the fallback, the control that violates the constraints least."""


@dataclass(slots=True)
class Decision:
    """What to execute and how it was found.

    Attributes:
        control: Shape (m,), finite, inside the box, a number of the action space's dtype.
        stage: What found it.
        infeasible: Nothing that was tried is admitted by every constraint.
        changed: It is not the proposal.
        refused: Which constraints did not admit the proposal, shape (number of constraints,); None: none did,
            or there was none to judge.
        fallback: The fallback chose it.
    """

    control: Array
    stage: Stage
    infeasible: bool = False
    changed: bool = True
    refused: NDArray[np.bool_] | None = None
    fallback: bool = False


class SafeActionSearch:
    """Finds the closest admissible control in the action box (`low`, `high`, shapes (m,)) that it can, or falls back.

    Controls are rounded to the action space's `dtype` before they are judged: what was admitted is executed.
    The caller observes the plant and the constraints.
    """

    def __init__(
        self,
        plant: Plant,
        constraints: Sequence[Bound],
        fallback: Fallback,
        low: Array,
        high: Array,
        dtype: Any = np.float64,
    ) -> None:
        self._dtype = np.dtype(dtype)
        self._plant, self._fallback, self._low, self._high = plant, fallback, low, high
        self._constraints = list(constraints)
        self._predicting = [c for c in constraints if c.predicts]
        self._guessing = [c for c in constraints if not c.rows_decide]
        self._ruling = [c for c in constraints if c.rows_decide]
        self._no_rows: Rows = np.zeros((0, low.size)), np.zeros(0)
        self._tried: list[Array] = []

    def decide(self, proposal: Array, last: Array) -> Decision:
        """The executed control for a proposal inside the box; `last` is what was executed before."""
        self._tried = []
        decision = self._decide(proposal, self._admitted(proposal), last)
        if decision.changed:
            decision.refused = np.array([not c.admits(proposal) for c in self._constraints], dtype=bool)
        return decision

    def _decide(self, proposal: Array, admitted: bool, last: Array) -> Decision:
        strict = self._rows(self._ruling)
        if admitted:
            if not strict[1].size:
                return Decision(proposal, Stage.PROPOSAL, changed=False)
            result, control = self._project(proposal, *strict)
            if result.status is Status.INACTIVE and control is proposal:
                return Decision(proposal, Stage.PROPOSAL, changed=False)
            if result.status in (Status.INFEASIBLE, Status.FAILED):
                return self._unprojected(result.status, control, last)
            if not self._predicting or self._admitted(control):
                return self._projected(proposal, control, Stage.ROWS)
        else:
            candidate = self.candidate(proposal, strict)
            if candidate is not None:
                return Decision(candidate, Stage.CANDIDATE)
        return self._search(proposal, strict, last)

    def candidate(self, proposal: Array, strict: Rows) -> Array | None:
        """The first candidate of a constraint that keeps the rows and every prediction."""
        known = (control for c in self._constraints for control in c.candidates(proposal))
        every = (self._rounded(control, *strict) for control in known)
        return next((control for control in every if self._keeps(control, strict)), None)

    def _search(self, proposal: Array, strict: Rows, last: Array) -> Decision:
        """Project on the rows of all constraints; where prediction refuses the answer, look closer."""
        rows = _joined(strict, self._rows(self._guessing))
        result, control = self._project(proposal, *rows)
        if result.status is Status.INFEASIBLE:
            # Linear rows of constraints that predict are only a guess: what counts is the others' rows.
            rows = strict
            result, control = self._project(proposal, *rows)
        if result.status in (Status.INFEASIBLE, Status.FAILED):
            return self._unprojected(result.status, control, last)
        if self._admitted(control):
            return self._projected(proposal, control, Stage.ROWS)
        admitted, control, rows = self.relinearize(proposal, control, rows, strict)
        if admitted:
            return self._projected(proposal, control, Stage.RELINEARIZED)
        return self._nearby(proposal, control, rows, strict, last)

    def relinearize(
        self, proposal: Array, control: Array, rows: Rows, strict: Rows
    ) -> tuple[bool, Array, Rows]:
        """Project again with rows linearised about each refused answer: whether one is admitted, it, its rows."""
        joined, left = rows, _LINEARIZATIONS
        while left:
            tangents = [c.linearize(control) for c in self._predicting if not c.admits(control)]
            lasting = self._stacked([t for t in tangents if not t.provisional])
            rows = _joined(rows, lasting)
            joined = _joined(rows, self._stacked([t for t in tangents if t.provisional]))
            if not any(t.offsets.size for t in tangents):
                break
            result, control = self._project(proposal, *joined)
            if result.status is Status.FAILED:
                break
            left -= lasting[1].size > 0
            # Where guesses and rows contradict each other, the answer violates both least: the rows count.
            contradictory = result.status is Status.INFEASIBLE
            if self._admitted(control) and (not contradictory or self._within(control, strict)):
                return True, self.shorten(proposal, control, strict), joined
        return False, control, joined

    def shorten(self, proposal: Array, control: Array, strict: Rows) -> Array:
        """An admitted control, or one nearer to the refused proposal that is admitted as well, on the line between.

        By secants of the room that is left; halfway where they were wrong.
        """
        refused, kept, found = 0.0, 1.0, control
        below, above = self._room(proposal), self._room(control)
        for _ in range(_TRIES):
            right = refused == 0.0 and np.isfinite(above - below) and above > below
            share = max(-(1.0 + _BEYOND) * below / (above - below), 0.1) if right else 0.5
            share = refused + share * (kept - refused)
            if kept - share < _WORTH:
                break
            nearer = self._rounded(proposal + share * (control - proposal), *strict)
            if self._keeps(nearer, strict):
                kept, above, found = share, self._room(nearer), nearer
            else:
                refused = share
        return found

    def _room(self, control: Array) -> float:
        """The least slack of what predicts, in shares of the scales."""
        return min((c.slack(control) / c.spec.scale for c in self._predicting), default=np.inf)

    def _nearby(self, proposal: Array, control: Array, rows: Rows, strict: Rows, last: Array) -> Decision:
        """More of the same correction, a backup control, or something in between; else the least violation."""
        more = self.overshoot(proposal, rows)
        if more is not None:
            return Decision(more, Stage.OVERSHOOT)
        backup = self.backup(strict)
        target = backup if backup is not None else self._fallback_control(control, last)
        admitted = backup is not None or self._keeps(target, strict)
        nearer = self.shorten(proposal, target, strict) if admitted else target
        blended = nearer if nearer is not target else self.blend(control, target, strict)
        if blended is not None:
            return Decision(blended, Stage.BLEND)
        if backup is not None:
            return Decision(backup, Stage.BACKUP)
        if admitted:
            return Decision(target, Stage.FALLBACK, fallback=True)
        least = self.least_violation(target, strict)
        for control in (least, target):
            if all(c.admits(control) or c.keeps_limit(control) for c in self._constraints):
                stage = Stage.FALLBACK if control is target else Stage.LEAST_VIOLATION
                return Decision(control, stage, fallback=True)
        stage = Stage.FALLBACK if least is target else Stage.LEAST_VIOLATION
        return Decision(least, stage, fallback=True, infeasible=True)

    def overshoot(self, proposal: Array, rows: Rows) -> Array | None:
        """A little more of a correction that was refused."""
        excess = np.maximum(rows[0] @ proposal - rows[1], 0.0)
        for share in _OVERSHOOTS if excess.any() else ():
            result, more = self._project(proposal, rows[0], rows[1] - share * excess)
            if result.status is Status.PROJECTED and self._admitted(more):
                return more
        return None

    def backup(self, strict: Rows) -> Array | None:
        """The first backup control of a constraint that keeps the rows and every prediction."""
        known = (c.backup() for c in self._constraints)
        every = [self._rounded(control, *strict) for control in known if control is not None]
        return next((control for control in every if self._keeps(control, strict)), None)

    def blend(self, control: Array, target: Array, strict: Rows) -> Array | None:
        """A refused control moved towards a target, along the line and then but for one component."""
        for share in _BLENDS:
            blended = self._rounded(control + share * (target - control), *strict)
            if self._keeps(blended, strict):
                return blended
        for j in range(target.size):
            mixed = target.copy()
            mixed[j] = control[j]
            if self._keeps(mixed, strict):
                return mixed
        return None

    def least_violation(self, target: Array, strict: Rows) -> Array:
        """Of all that was tried and the target, what violates least; the target if the fallback is not "brake"."""
        if not self._fallback.brakes:
            return target
        return max([target, *(u for u in self._tried if self._within(u, strict))], key=self._room)

    def without_proposal(self, last: Array) -> Decision:
        """The fallback's control, filtered like a policy's: for a proposal that is not finite."""
        decision = self.decide(self._fallback_control(None, last), last)
        decision.fallback = decision.changed = True
        decision.stage = Stage.FALLBACK
        decision.refused = None  # of the fallback's control; there was no proposal to refuse
        return decision

    def unreadable(self, last: Array) -> Decision:
        """The fallback alone: a state or a barrier that is not a number says nothing about any control."""
        control = self._fallback(self._plant, last, self._low, self._high, None, readable=False)
        return Decision(self._rounded(control, *self._no_rows), Stage.FALLBACK, fallback=True)

    def _projected(self, proposal: Array, control: Array, stage: Stage) -> Decision:
        return Decision(control, stage, changed=bool((control != proposal).any()))

    def _unprojected(self, status: Status, least: Array, last: Array) -> Decision:
        infeasible = status is Status.INFEASIBLE
        control = self._fallback_control(least if infeasible else None, last)  # a failed solve has no answer
        return Decision(control, Stage.FALLBACK, fallback=True, infeasible=infeasible)

    def _fallback_control(self, least: Array | None, last: Array) -> Array:
        control = self._fallback(self._plant, last, self._low, self._high, least, True)
        return self._rounded(control, *self._no_rows)

    def _rounded(self, control: Array, normals: Array, offsets: Array) -> Array:
        """A control inside the box, rounded as the env's action will be, towards the inside of its rows."""
        cast = cast_inside(control, self._dtype, normals, offsets, self._low, self._high)
        return np.asarray(cast, dtype=np.float64)

    def _admitted(self, control: Array) -> bool:
        for c in self._predicting:
            if not c.admits(control):
                self._tried.append(control)
                return False
        return True

    def _keeps(self, control: Array, strict: Rows) -> bool:
        # Comparisons with NaN are false, so a prediction may take what is not finite for admitted.
        return bool(np.isfinite(control).all()) and self._within(control, strict) and self._admitted(control)

    def _within(self, control: Array, strict: Rows) -> bool:
        return not strict[1].size or keeps_rows(control, *strict, self._low, self._high)

    def _rows(self, asked: list[Bound]) -> Rows:
        return self._stacked([c.rows() for c in asked])

    def _stacked(self, parts: list[HalfSpaces]) -> Rows:
        if len(parts) == 1:
            return parts[0].normals, parts[0].offsets
        if not parts:
            return self._no_rows
        return np.concatenate([p.normals for p in parts]), np.concatenate([p.offsets for p in parts])

    def _project(self, boxed: Array, normals: Array, offsets: Array) -> tuple[Projection, Array]:
        """The projection, and its control as it can be executed."""
        result, control = self._projection(boxed, normals, offsets)
        if result.status is Status.INACTIVE:
            return result, control
        rows = (normals, offsets) if result.status is Status.PROJECTED else self._no_rows
        return result, self._rounded(control, *rows)

    def _projection(self, boxed: Array, normals: Array, offsets: Array) -> tuple[Projection, Array]:
        lower, upper = self._plant.lower, self._plant.upper
        low, high = np.maximum(self._low, lower), np.minimum(self._high, upper)
        nominal = boxed if bool(((boxed >= low) & (boxed <= high)).all()) else np.clip(boxed, low, high)
        acting = self._plant.acting_range
        if acting is None or acting[0] is lower:
            result = project_unchecked(nominal, normals, offsets, low, high)
            return result, result.control
        least, most = np.clip(acting[0], low, high), np.clip(acting[1], low, high)
        # Measured in shares of what acts: a control that saturates early must not look cheap to change.
        force = np.clip(nominal, least, most)
        reach, box = most - least, high - low
        unit = np.where(known := (reach > 0.0) & np.isfinite(box), reach, 1.0) / np.where(known, box, 1.0)
        scaled = force / unit, normals * unit, offsets, least / unit, most / unit
        result = project_unchecked(*scaled)
        if result.status is Status.INACTIVE:
            return result, nominal
        # A component that saturates as the policy's did stays the policy's: the force is the same.
        return result, np.where(result.control == force / unit, nominal, result.control * unit)


def _joined(first: Rows, second: Rows) -> Rows:
    return np.concatenate([first[0], second[0]]), np.concatenate([first[1], second[1]])


class DiscreteSearch(SafeActionSearch):
    """The first candidate that every constraint admits, else what violates least; nothing lies between actions."""

    def _search(self, proposal: Array, strict: Rows, last: Array) -> Decision:
        least = self.least_violation(self._fallback_control(None, last), strict)
        stage = Stage.LEAST_VIOLATION if self._fallback.brakes else Stage.FALLBACK
        return Decision(least, stage, fallback=True, infeasible=True)

    def unreadable(self, last: Array) -> Decision:
        """The last action goes on, as there is no zero, unless the fallback is the user's own."""
        if self._fallback.custom:
            return super().unreadable(last)
        return Decision(last, Stage.FALLBACK, fallback=True)
