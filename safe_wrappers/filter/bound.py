"""Bound: a constraint on one plant, as the filter asks it about controls. Written once, for all constraints."""

import copy
import warnings
from collections.abc import Iterable
from typing import Any

import numpy as np

from safe_wrappers.control.projection import keeps_rows
from safe_wrappers.control.shapes import NUMBERS, squashed
from safe_wrappers.errors import Array, ConfigurationError
from safe_wrappers.filter.constraint import Constraint, HalfSpaces, Memory
from safe_wrappers.filter.linearize import Tangents, differences
from safe_wrappers.plants.plant import Plant

_KEPT = 10
"""Control steps for which slopes are kept where controls are displacements; trajectories check what follows."""
_LOWEST = -1e300
"""In the place of an h of minus infinity: what is as low admits nothing, and what is finite is better."""


class Bound:
    """A constraint on one plant: what is left of it in the observed state, and which controls it admits.

    In every control step `observe` comes first, after the plant's; then the other methods, in any order; last
    `executed`, whose memory `observe` takes in the next step.

    From inside, an admitted control keeps `h >= margin` along its trajectory. From outside it goes no farther out,
    and comes back at the rate of `recovery_s`, as far as the constraint's backup does; a limit that is kept is not
    lost. Where every trajectory goes on with the backup until rest, what is left of an admitted one is the backup of
    the next step, which is therefore admitted: that is the proof of constraints that promise "proved".

    Args:
        constraint: The specification, which is copied.
        plant: Bound to its env.

    Attributes:
        spec: The copy.
        memory: What the step has made of the episode's memory so far.
        predicts: Whether h of the trajectory decides.
        rows_decide: Whether the rows are the requirement, or a part of it: so where there is no h.
        measures_state: Whether h says something of the present state.
    """

    memory: Memory

    def __init__(self, constraint: Constraint, plant: Plant) -> None:
        self._given, self.plant = constraint, plant
        self._set_up()
        has_h = type(self.spec).h_along is not Constraint.h_along
        self.predicts = has_h and self.spec.predicts
        self.rows_decide = self.spec.rows_decide or not has_h
        self.measures_state = has_h and self.spec.measures_state
        self.max_decrease = self.spec.max_decrease

    def _set_up(self) -> None:
        """Let a copy of the constraint read what it needs of the plant's model."""
        self.spec = copy.copy(self._given)
        self.spec.report, self.spec.memory = {}, {}
        self.spec.setup(self.plant)
        self.model, self._blank = self.spec.model, dict(self.spec.report)
        # Last: what does not fit is refused at every observation.
        self._model_version = self.plant.model_version

    def forget_report(self) -> None:
        """Put the info keys of the constraint back to those of a state about which nothing is known."""
        self.spec.report = dict(self._blank)

    def observe(self, memory: Memory) -> None:
        """Take the plant's present state; after a change of its model the constraint is set up anew."""
        if self._model_version != self.plant.model_version:
            self._set_up()
        spec = self.spec
        self.memory = spec.memory = dict(memory)
        self._rows: HalfSpaces | None = None
        spec.observe(self.memory)
        now = spec.h_along(self.model.rollout(None))
        self._value = value = now[0] if len(now) == 1 else now.min(axis=0)
        self.least = least = float(value[0] if value.size == 1 else value.min(initial=np.inf))
        if not self.predicts:
            return
        self._known: dict[bytes, Array] = {}
        self._asked: tuple[Array, Array] | None = None
        self._tangents: Tangents | None = None
        self._is_outside = spec.recovery_s > 0.0 and least < spec.margin - spec.rounding
        self._far = False
        if self.max_decrease is not None:
            self._check_decrease(self.max_decrease)

    def _check_decrease(self, most: float) -> None:
        """Whether the state is so far inside that no trajectory is needed; the declared bound is checked here."""
        spec, recent = self.spec, self.memory.get("recent", ())
        fallen = max(recent, default=-np.inf) - self.least
        if fallen > most + spec.rounding:
            warnings.warn(
                f"{type(spec).__name__}: what is left of the limit fell by {fallen:.3g} {spec.unit} within "
                f"{len(recent)} control steps, farther than the declared max_decrease of {most:g}; from now on every "
                "control is forecast",
                stacklevel=2,
            )
            self.max_decrease = None
            return
        self._far = self.least - most >= spec.margin + spec.rounding

    def executed(self, control: Array) -> Memory:
        """The memory after a control was executed in the observed state."""
        memory, spec = self.memory, self.spec
        memory["control"] = control
        if self.predicts:
            if self.max_decrease is not None and np.isfinite(self.least):
                memory["recent"] = (*memory.get("recent", ()), self.least)[-spec.horizon :]
            if spec.info_keys:
                spec.h_along(self.model.rollout(control, spec.horizon))
            tangents = self._tangents
            if not (tangents is None or self.plant.has_acceleration or self._is_outside) and tangents.made:
                memory["slopes"], memory["kept_until"] = tangents.slopes, self.plant.observation_id + _KEPT
            self._tangents = None  # they refer to this object
        return memory

    def value(self) -> Array:
        """What is left now, margin not taken off, shape (k,); empty where nothing is measured or near."""
        found: Array = self._value
        return found

    def feature_count(self, neighbours: int) -> int:
        """How many `features` there are, at every state."""
        return 2 + NUMBERS * neighbours if hasattr(self.spec, "surroundings") else 1

    def features(self, neighbours: int) -> Array:
        """What a learner may be shown of the observed state, in [-1, 1].

        The first is the smallest h, squashed: `scale` is 0.5, and 1 is none at all. A constraint with obstacles adds
        the `neighbours` nearest.
        """
        surroundings: Any = getattr(self.spec, "surroundings", None)
        first = np.array([squashed(self.least, self.spec.scale)])
        return first if surroundings is None else np.concatenate([first, surroundings(neighbours)])

    def slacks(self, control: Array) -> Array:
        """What the trajectory of a control, shape (m,), leaves of what is asked for, shape (n,); wanted >= 0.

        In time: the least of every control interval, each of the k apart; from outside see `_of`.
        """
        key = control.tobytes()
        known = self._known.get(key)
        if known is None:
            spec, gate = self.spec, self.spec.look_ahead_below
            further = {"euler": True} if spec.euler_look_ahead else {}
            if gate is not None and not self._is_outside and self.least >= gate:
                held = self._of(self.model.rollout(control, 1, **further))
                known = held if bool((held >= gate).all()) else None
            if known is None:
                known = self._of(self.model.rollout(control, spec.horizon, **further))
            self._known[key] = known
        return known

    def _of(self, path: Any) -> Array:
        """The slacks of a trajectory; from outside, how far in it is on the way and at its end."""
        left = self.spec.h_along(path) - self.spec.margin
        if self._is_outside:
            least, end = self._wanted()
            return np.concatenate([left.min(axis=0) - least, left[-1] - end])
        holds, width = path.holds, left.shape[1]
        if not len(left):
            name = type(self.spec).__name__
            raise ConfigurationError(f"{name}.h_along must have at least one instant, got shape {left.shape}")
        return np.asarray(left.reshape(holds, len(left) // holds, width).min(axis=1).ravel())

    def _wanted(self) -> tuple[Array, Array]:
        """From outside: what a trajectory is to leave at least on the way, and at its end, margin taken off."""
        if self._asked is None:
            spec, least = self.spec, np.clip(self._value - self.spec.margin, _LOWEST, 0.0)
            end = least * np.exp(-spec.horizon * self.plant.control_dt / spec.recovery_s)
            backup = self.backup()
            if backup is not None:
                left = spec.h_along(self.model.rollout(backup, spec.horizon)) - spec.margin
                # Where the limit is kept now, not even the backup may lose it.
                lost = np.where(self._value >= 0.0, -spec.margin, _LOWEST)
                least = np.minimum(least, np.maximum(left.min(axis=0), lost))
                end = np.minimum(end, np.maximum(left[-1], lost))
            self._asked = least, end
        return self._asked

    def _about(self, control: Array) -> HalfSpaces:
        """Tangents of the slacks about a control."""
        if self._tangents is None:
            memory = self.memory
            keeps = self.plant.observation_id < memory.get("kept_until", 0) and not self._is_outside
            slopes = memory["slopes"] if keeps else None
            if slopes is not None and len(slopes) > self.slacks(control).size:
                slopes = None  # there are fewer obstacles than there were
            self._tangents = Tangents(self.slacks, self._slopes, slopes)
        return self._tangents.about(control)

    def _slopes(self, control: Array) -> Array:
        """How the slacks change with a control, shape (n, m), by differences.

        Left out are those of the control intervals after the last one in which a bound is violated most.
        """
        plant, needed, left = self.plant, self.spec.horizon, self.slacks(control)
        # A model of one's own may not count the intervals.
        if not self._is_outside and left.size % needed == 0:
            left = left.reshape(needed, -1)
            needed = int(np.where(left.min(axis=0) < 0.0, left.argmin(axis=0), 0).max()) + 1
        box = plant.lower, plant.upper
        return differences(lambda u: self._of(self.model.sketch(u, needed)), control, *box)

    def slack(self, control: Array) -> float:
        """The least of what a control leaves; >= 0: kept. Minus infinity where a number is lost."""
        if self.predicts:
            left = self.slacks(control)
        else:
            rows = self.rows()
            left = rows.offsets - rows.normals @ control
        least = float(left.min(initial=np.inf))
        return least if least == least else -np.inf

    def admits(self, control: Array) -> bool:
        """Whether a control, shape (m,), held for one control interval, keeps the requirement."""
        if self.rows_decide:
            rows = self.rows()
            if not keeps_rows(control, rows.normals, rows.offsets, self.plant.lower, self.plant.upper):
                return False
        return not self.predicts or self._far or self.slack(control) >= -self.spec.rounding

    def keeps_limit(self, control: Array) -> bool:
        """Inside the margin: whether a refused control keeps the limit, and loses no more of the margin.

        Asked where no control is admitted. Such a control is executed without being reported as infeasible.
        """
        spec = self.spec
        inside_margin = 0.0 <= self.least < spec.margin
        if not (self.predicts and spec.recovery_s and inside_margin) or self.rows_decide:
            return False
        left = spec.h_along(self.model.rollout(control, spec.horizon)).min(axis=0)
        return bool((left >= np.maximum(np.minimum(self._value, spec.margin) - spec.at_rest, 0.0)).all())

    def rows(self) -> HalfSpaces:
        """The half-spaces on the control.

        Where controls are displacements, tangents about braking: a refused displacement may press the machine against
        something, and then says little about others.
        """
        if self._rows is None:
            rows = self.spec.rows()
            if rows is None and self.predicts and not (self.plant.has_acceleration or self._far):
                braking = getattr(self.model, "braking", None)
                rows = None if braking is None else self._about(braking())
            self._rows = HalfSpaces.none(self.plant.lower.size) if rows is None else rows
        return self._rows

    def linearize(self, control: Array) -> HalfSpaces:
        """The requirement linearised about a refused control; no rows: it cannot be."""
        return self._about(control) if self.spec.smooth else HalfSpaces.none(control.size)

    def candidates(self, control: Array) -> Iterable[Array]:
        """Controls to try for a refused one before it is projected, the best first."""
        return self.spec.proposals(control)

    @property
    def may_back_up(self) -> bool:
        """Whether there may be a `backup`."""
        return type(self.spec).proposals is not Constraint.proposals

    def backup(self) -> Array | None:
        """The control that the constraint knows to keep it best, or None."""
        return next(iter(self.spec.proposals(None)), None)
