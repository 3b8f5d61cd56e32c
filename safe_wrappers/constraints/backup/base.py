"""The base of clearances that are counted along a backup manoeuvre."""

import math
from abc import abstractmethod
from typing import ClassVar

import numpy as np

from safe_wrappers.control.numerics.shapes import NUMBERS
from safe_wrappers.errors import Array
from safe_wrappers.filter.constraint import Constraint, Memory
from safe_wrappers.plants.plant import Model, Trajectory


class BackupClearance(Constraint, Model):
    """A clearance along a backup manoeuvre that leads to rest."""

    smooth: ClassVar[bool] = False
    recovery_s: ClassVar[float] = 0.0

    @abstractmethod
    def clearance(self) -> Array:
        """What the manoeuvre from the present state leaves, margin not taken off, m, shape (k,)."""

    @abstractmethod
    def leaves_clear(self, control: Array) -> bool:
        """Whether a held control and the manoeuvre after it keep the margin."""

    def rollout(self, control: Array | None, horizon: int = 1) -> Trajectory:
        return Trajectory(control, self.plant.state[None])

    def h_along(self, path: Trajectory) -> Array:
        if path.control is None:
            return self.clearance()[None]
        return np.array([[self.margin if self.leaves_clear(path.control) else -math.inf]])


class DetourClearance(BackupClearance):
    """A backup clearance whose proposals lead around an obstacle, and keep to one side of it."""

    detour_steps: ClassVar[int]
    """Control steps for which a side is kept after it was last needed, so that proposals do not alternate."""

    @abstractmethod
    def nearest(self, neighbours: int) -> Array:
        """The nearest discs in the machine's frame: see `control/numerics/shapes.py`."""

    def surroundings(self, neighbours: int) -> Array:
        """The side of the present detour by the share of its time that is left, and the nearest discs."""
        left = self._kept_side() * self.memory.get("detour", (0.0, 0))[1] / self.detour_steps
        found = self.nearest(neighbours)
        assert found.size == NUMBERS * neighbours
        return np.concatenate([[left], found])

    def observe(self, memory: Memory) -> None:
        side, steps = memory.get("detour", (0.0, 0))
        memory["detour"] = side, steps - 1 if memory.get("control") is not None else steps

    def _kept_side(self) -> float:
        """The side of the present detour, or 0."""
        side, steps = self.memory["detour"]
        return float(side) if steps > 0 else 0.0

    def _keep_side(self, side: float) -> None:
        """A detour on this side is needed now."""
        self.memory["detour"] = side, self.detour_steps
