"""The base of clearances that are counted along a backup manoeuvre."""

import math
from abc import abstractmethod
from typing import ClassVar, NamedTuple

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.control.numerics.shapes import NUMBERS
from safe_wrappers.filter.constraint import BoundConstraint, Memory


class BoundBackupClearance(BoundConstraint):
    """A clearance along a backup manoeuvre, on a plant.

    The manoeuvre leads to a state that may last, for example full braking until rest. A control is admitted if the
    held control, and the manoeuvre after it, keep the clearance. So from a safe state the first control of the
    manoeuvre is always admitted, for any number of obstacles at once.

    A subclass overrides `clearance`, `admits` and `backup`. It may override `candidates` and `rows`, and `slack`
    where it can measure it. Constants of the model are read in `__init__`: a filter binds anew when the model has
    changed. The specification has a `margin`, m.
    """

    predicts: bool = True

    @abstractmethod
    def clearance(self) -> Array:
        """Read the plant's state: what the manoeuvre from there leaves, margin not taken off, m, shape (k,).

        Called once in every control step. k may be 0: there is nothing to keep clear of.
        """

    @abstractmethod
    def backup(self) -> Array:
        """The first control of the manoeuvre, shape (m,)."""

    def observe(self, memory: Memory) -> None:
        self._memory = memory
        self._value = self.clearance()

    def value(self) -> Array:
        """The clearance along the manoeuvre, margin not taken off, m, shape (k,)."""
        return self._value

    @abstractmethod
    def admits(self, control: Array) -> bool:
        """Whether a held control and the manoeuvre after it keep the margin; the way of the held control counts.

        It must admit the first control of the manoeuvre from a safe state, whatever rounding has taken.
        """

    def slack(self, control: Array) -> float:
        """Not measured: 0 for a control that is admitted, else minus infinity."""
        return 0.0 if self.admits(control) else -math.inf


class Detour(NamedTuple):
    """The side on which an obstacle is passed (1.0 left, -1.0 right), and the control steps for which it is kept."""

    side: float = 0.0
    steps: int = 0


class BoundDetourClearance(BoundBackupClearance):
    """A backup clearance whose candidates lead around an obstacle, and keep to one side of it."""

    detour_steps: ClassVar[int]
    """Control steps for which a side is kept after it was last needed, so that candidates do not alternate."""
    _memory: Detour

    @abstractmethod
    def nearest(self, neighbours: int) -> Array:
        """The nearest discs in the machine's frame: see `control/numerics/shapes.py`."""

    def feature_count(self, neighbours: int) -> int:
        return 2 + NUMBERS * neighbours

    def features(self, neighbours: int) -> Array:
        """The clearance, the side of the present detour by the share of its time that is left, the nearest discs."""
        left = self._kept_side() * self._memory.steps / self.detour_steps
        return np.concatenate([super().features(neighbours), [left], self.nearest(neighbours)])

    def start(self) -> Memory:
        return Detour()

    def executed(self, control: Array) -> Memory:
        return Detour(self._memory.side, self._memory.steps - 1)

    def _kept_side(self) -> float:
        """The side of the present detour, or 0."""
        return self._memory.side if self._memory.steps > 0 else 0.0

    def _keep_side(self, side: float) -> None:
        """A detour on this side is needed now."""
        self._memory = Detour(side, self.detour_steps)
