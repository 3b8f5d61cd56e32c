"""What a constraint is: half-spaces on the control, from a plant, at one moment."""

from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.errors import ConfigurationError

Array = NDArray[np.float64]

Promise = Literal["proved", "best effort"]


@dataclass(frozen=True, slots=True)
class HalfSpaces:
    """`normals @ u <= offsets`, in physical control units.

    Attributes:
        normals: Shape (k, m). A row that asks for nothing is left out, never padded.
        offsets: Shape (k,).
    """

    normals: Array
    offsets: Array

    @staticmethod
    def none(controls: int) -> "HalfSpaces":
        """No rows: nothing is asked for at this state."""
        return HalfSpaces(np.zeros((0, controls)), np.zeros(0))


@runtime_checkable
class Constraint(Protocol):
    """One safety requirement.

    A class with `rows` alone is enough. `value(plant)` (the barrier h, shape (k,), positive inside) lets the
    filter report a margin. `bind(plant)` resolves names once, and refuses unknown ones; `check(plant)` refuses
    at a reset what only a state can show; `reset()` forgets an episode. `promise` says what holds: "proved" or
    "best effort". `report(proposed, executed)` returns info keys of its own, always the same ones, after every
    reset (with two equal actions) and step. `admits` belongs to `CertifyingConstraint`. The plant is any `Plant`;
    a constraint that needs a particular one refuses others in `bind`.
    """

    def rows(self, plant: Any) -> HalfSpaces:
        """The half-spaces on the control at the plant's present state."""


@runtime_checkable
class CertifyingConstraint(Constraint, Protocol):
    """A constraint that can check a held control exactly, by prediction.

    The filter asks it before it computes rows (a check is cheaper and less conservative than a linear bound),
    and again after every projection, because rows are linear and the machine is not.
    """

    def admits(self, plant: Any, control: Array) -> bool:
        """Whether holding `control` for one control interval keeps the requirement, and keeps it keepable."""


def positive(name: str, value: float, unit: str) -> float:
    """A finite number above zero, or an error that names the parameter and its unit."""
    number = _number(name, value, unit)
    if not (np.isfinite(number) and number > 0.0):
        raise ConfigurationError(f"{name} must be a finite number > 0 in {unit}, got {value!r}")
    return number


def non_negative(name: str, value: float, unit: str) -> float:
    """A finite number of at least zero, or an error that names the parameter and its unit."""
    number = _number(name, value, unit)
    if not (np.isfinite(number) and number >= 0.0):
        raise ConfigurationError(f"{name} must be a finite number >= 0 in {unit}, got {value!r}")
    return number


def _number(name: str, value: Any, unit: str) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        raise ConfigurationError(f"{name} must be a number in {unit}, got {value!r}") from None
