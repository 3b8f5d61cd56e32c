"""What clearances share whose proposals lead around discs: their checks, and the memory of a detour."""

from abc import abstractmethod
from typing import ClassVar

import numpy as np

from safe_wrappers.constraints.obstacles import Disc, Discs, obstacles_from
from safe_wrappers.errors import Array, ConfigurationError, true_or_false
from safe_wrappers.filter.constraint import Constraint, Memory


class Detour(Constraint):
    """Part of a clearance whose proposals lead around an obstacle, and keep to one side of it."""

    detour_steps: ClassVar[int]
    """Control steps for which a side is kept after it was last needed, so that proposals do not alternate."""
    detour: bool

    def _check_shared(self, *names: str) -> None:
        """Check `detour`, and the fields of these names: discs that stand still, or none."""
        self.detour = true_or_false("detour", self.detour)
        for name in names:
            discs = obstacles_from(getattr(self, name), name, (Disc, Discs), optional=True)
            if any(getattr(disc, "velocity_attribute", None) is not None for disc in discs):
                raise ConfigurationError(f"{name}: the way to rest is forecast past discs that stand still")
            setattr(self, name, discs)

    @abstractmethod
    def nearest(self, neighbours: int) -> Array:
        """The nearest discs in the machine's frame: see `control/shapes.py`."""

    def surroundings(self, neighbours: int) -> Array:
        """The side of the present detour by the share of its time that is left, and the nearest discs."""
        left = self._kept_side() * self.memory.get("detour", (0.0, 0))[1] / self.detour_steps
        return np.concatenate([[left], self.nearest(neighbours)])

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
