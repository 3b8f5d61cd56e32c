"""What a constraint is: a specification, and what it becomes on a plant."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array
from safe_wrappers.control.numerics.shapes import squashed
from safe_wrappers.drawing.marks import Mark
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.plant import Plant

Promise = Literal["proved", "best effort"]
Memory = Any
"""What a bound constraint keeps from one control step to the next; None if nothing."""


@dataclass(frozen=True, slots=True)
class HalfSpaces:
    """`normals @ u <= offsets`, in physical control units.

    Attributes:
        normals: Shape (k, m). A row that asks for nothing is left out, never padded.
        offsets: Shape (k,).
        provisional: Tangents that are replaced by the constraint's next ones, not joined by them.
    """

    normals: Array
    offsets: Array
    provisional: bool = False

    @staticmethod
    def none(controls: int) -> "HalfSpaces":
        """No rows: nothing is asked for at this state."""
        return HalfSpaces(np.zeros((0, controls)), np.zeros(0))


class Constraint:
    """One safety requirement, as a specification: plain data, bound to no env.

    A subclass is a dataclass that checks its fields. On a plant it becomes the `BoundConstraint` that is declared
    `of` it, or what its own `bind` returns.

    Attributes:
        promise: What holds for an executed control that is not flagged: "proved" or "best effort".
    """

    promise: Promise = "best effort"
    measures_approach: ClassVar[bool] = False
    """Whether `BoundConstraint.approach` measures clearance and approach speed."""
    simulates: ClassVar[bool] = False
    """Whether it needs a plant that rolls out policies, `SimulatorPlant` by default."""
    margin = 0.0
    """Kept free before the limit, in the constraint's own unit."""
    state_error = 0.0
    """Bound on the error of what is measured, in the same unit."""

    _becomes: ClassVar[type["BoundConstraint"]]

    def bind(self, plant: Plant) -> "BoundConstraint":
        """The constraint on a plant that is bound to its env.

        Raises:
            UnsupportedEnvError: The plant does not have what the constraint needs.
            ConfigurationError: Names or numbers that do not fit the plant.
        """
        return self._becomes(self, plant)

    def widened(self, margin: float) -> Self:
        """A copy whose margin is wider by this much, in the unit of its margin."""
        if not (is_dataclass(self) and any(f.name == "margin" for f in fields(self))):
            name = type(self).__name__
            raise ConfigurationError(f"{name} has no margin to widen; give it a field `margin`, or margin=0")
        own: Any = self
        wider: Self = replace(own, margin=own.margin + margin)
        return wider


class BoundConstraint:
    """A constraint on one plant. Every method has a default; a subclass overrides what it can answer.

    In every control step the filter calls `observe` once, after the plant has taken the env's state, then the other
    methods, and closes the step with `executed`. What lasts from step to step is a value: `start` gives that of a new
    episode, `observe` takes it, `executed` returns the next one. A constraint may keep what it has computed until the
    next `observe`, and must not change anything else.

    A constraint that says its requirement as rows overrides `rows` alone. One that predicts a held control sets
    `predicts` and overrides `slack`, or `admits`; its rows are then a guess.

    `class BoundThis(BoundConstraint, of=This)` is what `This.bind` returns.

    Args:
        spec: The specification.
        plant: Bound to its env.
    """

    predicts: bool = False
    """Whether `admits` and `slack` predict a held control; else they evaluate the rows."""
    has_value: bool = False
    """Whether there is a barrier: set for every subclass that overrides `value`."""
    has_backup: bool = False
    """Whether it knows a backup control: set for every subclass that overrides `backup`."""
    tolerance: float = 0.0
    """How far below zero a slack may be and count as rounding."""
    info_keys: tuple[str, ...] = ()
    """The keys that `info` writes."""

    def __init_subclass__(cls, of: type[Constraint] | None = None, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if of is not None:
            of._becomes = cls
        cls.has_value = cls.value is not BoundConstraint.value
        cls.has_backup = cls.backup is not BoundConstraint.backup

    def __init__(self, spec: Any, plant: Any) -> None:
        self.spec, self.plant = spec, plant

    @property
    def scale(self) -> float:
        """A typical size of the slack, to compare constraints of different units."""
        return 1.0

    def start(self) -> Memory:
        """The memory at the start of an episode."""
        return None

    def observe(self, memory: Memory) -> None:
        """Take the plant's present state and the memory."""

    def check(self) -> None:
        """Refuse at a reset what only a state can show."""

    def load(self) -> None:
        """Run once, in the first observed state, the compiled code that a step may need."""

    def value(self) -> Array:
        """The barriers h, shape (k,), positive inside; the margin is not taken off. k may be 0: nothing is near."""
        return np.zeros(0)

    def feature_count(self, neighbours: int) -> int:
        """How many `features` there are, at every state."""
        return 1

    def features(self, neighbours: int) -> Array:
        """What a learner may be shown of the observed state, in [-1, 1], shape (feature_count,).

        The first is the smallest h, squashed: `scale` is 0.5, and 1 is none at all. A constraint with obstacles adds
        the `neighbours` nearest.
        """
        lowest = float(self.value().min(initial=np.inf))
        return np.array([squashed(lowest, self.scale)])

    def approach(self) -> tuple[Array, Array] | None:
        """Clearances in m and approach speeds in m/s, shapes (k,), or None: they are not measured."""
        return None

    def rows(self) -> HalfSpaces:
        """The half-spaces on the control."""
        return HalfSpaces.none(self.plant.lower.size)

    def slack(self, control: Array) -> float:
        """What a control, shape (m,), leaves of the requirement, in its unit; >= 0: kept. NaN counts as lost."""
        rows = self.rows()
        return float((rows.offsets - rows.normals @ control).min(initial=np.inf))

    def admits(self, control: Array) -> bool:
        """Whether a control, held for one control interval, keeps the requirement."""
        return self.slack(control) >= -self.tolerance

    def keeps_limit(self, control: Array) -> bool:
        """Inside the margin: whether a refused control keeps the limit, and loses no more of the margin.

        Asked where no control is admitted. Such a control is executed without being reported as infeasible.
        """
        return False

    def linearize(self, control: Array) -> HalfSpaces:
        """The requirement linearised about a refused control; no rows: it cannot be."""
        return HalfSpaces.none(self.plant.lower.size)

    def candidates(self, control: Array) -> Iterable[Array]:
        """Controls to try for a refused one before it is projected, the best first; only admitted ones are taken."""
        return ()

    def backup(self) -> Array | None:
        """A control that the constraint knows to keep it, shape (m,), or None."""
        return None

    @classmethod
    def batch(cls, bound: Sequence[Self]) -> "ConstraintBatch | None":
        """The same constraint on the plants of n envs, judged in one call, or None: one by one.

        Asked where each is the only constraint of its env.
        """
        return None

    def executed(self, control: Array) -> Memory:
        """The memory after a control was executed in the observed state."""
        return None

    def draw(self) -> Sequence[Mark]:
        """What a picture of the observed state shows of the constraint (`SafetyOverlay`), in world coordinates."""
        return ()

    def info(self, proposed: Array | None, executed: Array | None) -> dict[str, Any]:
        """The info keys of its own, always the same; None: nothing was judged yet, or the state is not a number."""
        return {}


class ConstraintBatch(ABC):
    """The bound constraints of n envs with one action box; `BoundConstraint.batch` makes it.

    It judges proposals as the constraints one by one, bit for bit.
    """

    @abstractmethod
    def restart(self, env: int, memory: Memory) -> None:
        """Take an env's new episode, or the memory that its own constraint was left with."""

    @abstractmethod
    def memory(self, env: int) -> Memory:
        """What the constraint of an env remembers, as its own `start` and `executed` give it."""

    @abstractmethod
    def judge(self, proposals: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Take every env's present state.

        Args:
            proposals: Inside the action box, shape (n, m); rows with NaN get an arbitrary answer.

        Returns:
            The smallest h of each env, shape (n,), NaN if one is not a number; whether its proposal is admitted,
            shape (n,).
        """

    @abstractmethod
    def executed(self, envs: NDArray[np.bool_]) -> None:
        """Remember that the proposals of these envs, shape (n,), which were admitted, are executed."""
