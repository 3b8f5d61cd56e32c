"""Argument checks and sums of energy ports: effort and flow of one step, positive numbers, energies."""

import math

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, finite_array, float_array
from safe_wrappers.errors import ConfigurationError


def same_shape(**values: ArrayLike) -> tuple[Array, Array]:
    """Two finite arrays of one shape, without broadcasting."""
    first, second = (finite_array(name, value) for name, value in values.items())
    if first.shape != second.shape:
        a, b = values
        raise ConfigurationError(f"expected {a} and {b} of one shape, got {first.shape} and {second.shape}")
    return first, second


def port_vector(name: str, value: ArrayLike) -> Array:
    """One quantity of a port as (m,); a number is (1,). `port_energy` checks that it is finite."""
    vector = float_array(name, value)
    if vector.ndim > 1 or vector.size == 0:
        raise ConfigurationError(f"expected {name} as a number or of shape (m,), got {vector.shape}")
    return vector.reshape(-1)


def port_vectors(**values: ArrayLike) -> tuple[Array, Array]:
    """Effort and flow of one port, see `port_vector`, of one size."""
    first, second = (port_vector(name, value) for name, value in values.items())
    if first.size != second.size:
        a, b = values
        raise ConfigurationError(f"expected {a} and {b} of one size, got {first.size} and {second.size}")
    return first, second


def port_energy(effort: Array, flow: Array, time_s: float) -> float:
    """`F.v dt`, J; a product that is not finite is refused."""
    # The product is checked instead of both factors, which saves time at every tick.
    with np.errstate(over="ignore", invalid="ignore"):
        energy = float(effort @ flow) * time_s
    if not math.isfinite(energy):
        raise ConfigurationError(f"effort, flow and so their product must be finite; got {effort}, {flow}")
    return energy


def _is_number(value: object) -> bool:
    """Whether it is a real scalar of Python or NumPy, or an array without axes."""
    return isinstance(value, (int, float, np.number)) or (
        isinstance(value, np.ndarray) and value.ndim == 0 and value.dtype.kind in "iuf"
    )


def positive(name: str, value: float) -> float:
    """A finite number above 0."""
    if not (_is_number(value) and math.isfinite(value) and value > 0.0):
        raise ConfigurationError(f"{name} must be a finite number above 0, got {value!r}")
    return float(value)


def energy_j(name: str, value: float) -> float:
    """A finite energy, at least 0."""
    if not (_is_number(value) and math.isfinite(value) and value >= 0.0):
        raise ConfigurationError(f"{name} must be a finite energy of at least 0 J, got {value!r}")
    return float(value)


class RunningSum:
    """The sum of the numbers added so far: compensated (Neumaier), accurate to about one rounding."""

    def __init__(self, start: float = 0.0) -> None:
        self._sum = start
        self._lost = 0.0

    def add(self, value: float) -> None:
        """Add one finite number."""
        total = self._sum + value
        if abs(self._sum) >= abs(value):
            self._lost += (self._sum - total) + value
        else:
            self._lost += (value - total) + self._sum
        self._sum = total

    @property
    def value(self) -> float:
        """The sum."""
        return self._sum + self._lost
