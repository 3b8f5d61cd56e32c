"""What lies under a wheel: a ground everywhere, and discs of other grounds on it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from safe_wrappers.appendix.vehicle.traction_curves import MAGIC_FORMULA, MagicFormula

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
