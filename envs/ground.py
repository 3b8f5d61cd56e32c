"""What lies under a wheel: a ground everywhere, and discs of other grounds on it; the traction of each.

The curve is Pacejka's Magic Formula without curvature (H. Pacejka, Tire and Vehicle Dynamics), of tyres on roads: a
robot's wheel has its own, to be measured.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class MagicFormula:
    """Longitudinal friction over slip, `mu = D sin(C atan(B s))`; slips beyond 1 in size count as 1.

    Attributes:
        peak_friction: D.
        peak_slip: Where it is reached, in (0, 1).
        shape: C, in (1, 2): how far the curve falls beyond its peak.
        stiffness: B.
    """

    peak_friction: float
    peak_slip: float
    shape: float = 1.65
    stiffness: float = field(init=False)

    def __post_init__(self) -> None:
        stiffness = math.tan(math.pi / (2.0 * self.shape)) / self.peak_slip
        object.__setattr__(self, "stiffness", stiffness)

    def friction(self, slip: ArrayLike) -> NDArray[np.float64]:
        """Coefficient, any shape, with the slip's sign."""
        x = self.stiffness * np.clip(np.asarray(slip, dtype=np.float64), -1.0, 1.0)
        return np.asarray(self.peak_friction * np.sin(self.shape * np.arctan(x)))

    def at(self, slip: float) -> float:
        """The same for one number, without arrays: for loops over physics substeps."""
        x = self.stiffness * max(-1.0, min(slip, 1.0))
        return self.peak_friction * math.sin(self.shape * math.atan(x))


MAGIC_FORMULA: Final[Mapping[str, MagicFormula]] = MappingProxyType(
    {
        "dry": MagicFormula(1.0, 0.14),
        "wet": MagicFormula(0.7, 0.12),
        "snow": MagicFormula(0.3, 0.15),
        "ice": MagicFormula(0.1, 0.10),
    }
)
"""By ground; at slip 1 about two thirds of the peak remain."""
GROUNDS: Final = tuple(MAGIC_FORMULA)
"""Names of the grounds, from the best grip to the least."""


@dataclass(frozen=True)
class Patch:
    """A disc of another ground.

    Attributes:
        ground: One of `GROUNDS`.
        center: x, y, m.
        radius: m.
    """

    ground: str
    center: tuple[float, float]
    radius: float


class Ground:
    """A field's grounds, asked point by point: plain numbers, because every wheel asks at every physics substep.

    Args:
        base: The ground everywhere else, one of `GROUNDS`.
        patches: Where two overlap, the later one lies on top.
    """

    def __init__(self, base: str, patches: Sequence[Patch]) -> None:
        self.base, self.patches = base, tuple(patches)
        self._base = MAGIC_FORMULA[base]
        self._discs = [(*p.center, p.radius**2, p) for p in reversed(self.patches)]

    def at(self, x: float, y: float) -> str:
        """Name of the ground at a point, m."""
        for cx, cy, square, patch in self._discs:
            dx, dy = x - cx, y - cy
            if dx * dx + dy * dy <= square:
                return patch.ground
        return self.base

    def curve_at(self, x: float, y: float) -> MagicFormula:
        """Traction curve at a point, m."""
        for cx, cy, square, patch in self._discs:
            dx, dy = x - cx, y - cy
            if dx * dx + dy * dy <= square:
                return MAGIC_FORMULA[patch.ground]
        return self._base
