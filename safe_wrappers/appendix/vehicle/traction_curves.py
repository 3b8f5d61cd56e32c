"""Traction curves: longitudinal friction over slip, with a peak and a falling slope beyond it.

Pacejka's Magic Formula, odd in slip. Burckhardt's curve is in `safe_wrappers.appendix.vehicle.burckhardt`.

Source: appendix "Wheel slip ratio and friction boundaries"; H. Pacejka, Tire and Vehicle Dynamics. The curves are of
tyres on roads: a robot's wheel has its own, to be measured.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, Protocol

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError


class TractionCurve(Protocol):
    """Friction coefficient over slip, odd; slips beyond 1 in size count as 1."""

    def friction(self, slip: ArrayLike) -> Array:
        """Coefficient, any shape, with the slip's sign."""

    def at(self, slip: float) -> float:
        """The same for one number, without arrays: for loops over physics steps."""

    def slope(self, slip: ArrayLike) -> Array:
        """Its derivative, any shape; 0 beyond 1."""


@dataclass(frozen=True, slots=True)
class MagicFormula:
    """`mu = D sin(C atan(B s - E (B s - atan(B s))))`.

    Attributes:
        stiffness: B.
        shape: C, in (1, 2): how far the curve falls beyond its peak.
        peak_friction: D, > 0.
        curvature: E, <= 1.
    """

    stiffness: float
    shape: float
    peak_friction: float
    curvature: float = 0.0

    def __post_init__(self) -> None:
        check_range("stiffness", self.stiffness, 0.0, math.inf)
        check_range("shape", self.shape, 1.0, 2.0)
        check_range("peak_friction", self.peak_friction, 0.0, math.inf)
        if not self.curvature <= 1.0:
            raise ConfigurationError(f"curvature must be <= 1, got {self.curvature!r}")

    @classmethod
    def from_peak(cls, peak_friction: float, peak_slip: float, shape: float = 1.65) -> "MagicFormula":
        """The curve with E = 0 and a given peak at a slip in (0, 1)."""
        check_range("peak_slip", peak_slip, 0.0, 1.0)
        check_range("shape", shape, 1.0, 2.0)
        return cls(math.tan(math.pi / (2.0 * shape)) / peak_slip, shape, peak_friction)

    def friction(self, slip: ArrayLike) -> Array:
        """Coefficient, any shape, with the slip's sign."""
        x = self.stiffness * clipped(slip)
        bent = x - self.curvature * (x - np.arctan(x))
        return np.asarray(self.peak_friction * np.sin(self.shape * np.arctan(bent)))

    def at(self, slip: float) -> float:
        """The same for one number."""
        x = self.stiffness * max(-1.0, min(slip, 1.0))
        bent = x - self.curvature * (x - math.atan(x)) if self.curvature else x
        return self.peak_friction * math.sin(self.shape * math.atan(bent))

    def slope(self, slip: ArrayLike) -> Array:
        """Its derivative, any shape; 0 beyond 1."""
        s = np.asarray(slip, dtype=np.float64)
        x = self.stiffness * s
        bent = x - self.curvature * (x - np.arctan(x))
        bending = self.stiffness * (1.0 - self.curvature * (1.0 - 1.0 / (1.0 + x * x)))
        inner = self.shape * np.arctan(bent)
        steep = self.peak_friction * np.cos(inner) * self.shape / (1.0 + bent * bent) * bending
        return np.asarray(np.where(np.abs(s) <= 1.0, steep, 0.0))


def clipped(slip: ArrayLike) -> Array:
    """Slip clipped to [-1, 1], any shape."""
    return np.asarray(np.clip(np.asarray(slip, dtype=np.float64), -1.0, 1.0))


def check_range(name: str, value: float, low: float, high: float) -> None:
    """Refuse a number that is not in the open interval."""
    if not (math.isfinite(value) and low < value < high):
        raise ConfigurationError(f"{name} must be a finite number in ({low:g}, {high:g}), got {value!r}")


MAGIC_FORMULA: Final[Mapping[str, MagicFormula]] = MappingProxyType(
    {
        "dry": MagicFormula.from_peak(peak_friction=1.0, peak_slip=0.14),
        "wet": MagicFormula.from_peak(peak_friction=0.7, peak_slip=0.12),
        "snow": MagicFormula.from_peak(peak_friction=0.3, peak_slip=0.15),
        "ice": MagicFormula.from_peak(peak_friction=0.1, peak_slip=0.10),
    }
)
"""By ground; at slip 1 about two thirds of the peak remain. Used by `SafeRover-v0`."""
