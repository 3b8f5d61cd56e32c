"""Burckhardt's traction curve, and the peak of any traction curve.

`BURCKHARDT` holds one curve per ground, with the peak between slips of 0.10 and 0.15; `BURCKHARDT_PUBLISHED` holds
the coefficients as published, whose peaks lie at 0.17 (dry), 0.13 (wet), 0.06 (snow) and nowhere (ice).

Source: appendix "Wheel slip ratio and friction boundaries"; M. Burckhardt, Fahrwerktechnik: Radschlupf-
Regelsysteme, 1993 (coefficients as reprinted in U. Kiencke and L. Nielsen, Automotive Control Systems).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.appendix.vehicle.traction_curves import TractionCurve, check_range, clipped
from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError


class Peak(NamedTuple):
    """Where a curve is highest.

    Attributes:
        slip: In (0, 1].
        friction: The coefficient there.
    """

    slip: float
    friction: float


@dataclass(frozen=True, slots=True)
class Burckhardt:
    """`mu = c1 (1 - exp(-c2 s)) - c3 s` for s >= 0, mirrored.

    Attributes:
        c1: > 0.
        c2: > 0.
        c3: >= 0; the falling slope.
    """

    c1: float
    c2: float
    c3: float

    def __post_init__(self) -> None:
        check_range("c1", self.c1, 0.0, math.inf)
        check_range("c2", self.c2, 0.0, math.inf)
        if not (math.isfinite(self.c3) and self.c3 >= 0.0):
            raise ConfigurationError(f"c3 must be a finite number >= 0, got {self.c3!r}")

    @classmethod
    def from_peak(cls, peak_friction: float, peak_slip: float, sliding_friction: float) -> "Burckhardt":
        """The curve with a peak where it is wanted and a coefficient at slip 1.

        Args:
            peak_friction: > 0.
            peak_slip: In (0, 0.5).
            sliding_friction: At slip 1, in (0, peak_friction).

        Raises:
            ConfigurationError: A number out of its range.
        """
        check_range("peak_slip", peak_slip, 0.0, 0.5)
        check_range("sliding_friction", sliding_friction, 0.0, peak_friction)

        def with_rate(c2: float) -> Burckhardt:
            left = math.exp(-c2 * peak_slip)
            c1 = peak_friction / (1.0 - left - c2 * left * peak_slip)
            return cls(c1, c2, c1 * c2 * left)

        # The steeper the rise, the less has to fall off behind the peak.
        slow, fast = 1e-3 / peak_slip, 50.0 / peak_slip
        for _ in range(200):
            middle = math.sqrt(slow * fast)
            slow, fast = (middle, fast) if with_rate(middle).at(1.0) < sliding_friction else (slow, middle)
        return with_rate(fast)

    def friction(self, slip: ArrayLike) -> Array:
        """Coefficient, any shape, with the slip's sign."""
        s = clipped(slip)
        size = np.abs(s)
        return np.asarray(np.sign(s) * (-self.c1 * np.expm1(-self.c2 * size) - self.c3 * size))

    def at(self, slip: float) -> float:
        """The same for one number."""
        size = min(abs(slip), 1.0)
        friction = -self.c1 * math.expm1(-self.c2 * size) - self.c3 * size
        return friction if slip >= 0.0 else -friction

    def slope(self, slip: ArrayLike) -> Array:
        """Its derivative, any shape; 0 beyond 1."""
        size = np.abs(np.asarray(slip, dtype=np.float64))
        steep = self.c1 * self.c2 * np.exp(-self.c2 * size) - self.c3
        return np.asarray(np.where(size <= 1.0, steep, 0.0))


def peak(curve: TractionCurve) -> Peak:
    """Where a curve is highest on (0, 1], to 1e-12 in slip; a curve that never falls is highest at 1."""
    grid = np.linspace(0.0, 1.0, 1001)
    best = int(curve.friction(grid).argmax())
    if float(curve.slope(1.0)) >= 0.0:
        return Peak(1.0, curve.at(1.0))
    low, high = float(grid[max(best - 1, 0)]), float(grid[min(best + 1, grid.size - 1)])
    while high - low > 1e-12:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if float(curve.slope(middle)) > 0.0 else (low, middle)
    return Peak(low, curve.at(low))


BURCKHARDT: Final[Mapping[str, Burckhardt]] = MappingProxyType(
    {
        "dry": Burckhardt.from_peak(peak_friction=1.0, peak_slip=0.14, sliding_friction=0.66),
        "wet": Burckhardt.from_peak(peak_friction=0.7, peak_slip=0.12, sliding_friction=0.45),
        "snow": Burckhardt.from_peak(peak_friction=0.3, peak_slip=0.15, sliding_friction=0.2),
        "ice": Burckhardt.from_peak(peak_friction=0.1, peak_slip=0.10, sliding_friction=0.065),
    }
)
"""By ground, with the peaks of `MAGIC_FORMULA` and nearly its friction at slip 1."""


BURCKHARDT_PUBLISHED: Final[Mapping[str, Burckhardt]] = MappingProxyType(
    {
        "dry": Burckhardt(1.2801, 23.99, 0.52),
        "wet": Burckhardt(0.857, 33.822, 0.347),
        "snow": Burckhardt(0.1946, 94.129, 0.0646),
        "ice": Burckhardt(0.05, 306.39, 0.0),
    }
)
"""By ground: asphalt dry and wet, snow, ice."""
