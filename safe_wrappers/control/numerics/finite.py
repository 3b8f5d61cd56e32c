"""Arguments as arrays: finite numbers, of shapes that fit together, or an error that names them."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.errors import ConfigurationError

Array = NDArray[np.float64]


def finite_array(name: str, value: ArrayLike) -> Array:
    """One value as float64, any shape.

    Raises:
        ConfigurationError: What is no number, or not finite; it names the argument.
    """
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ConfigurationError(f"{name} is a number or an array of numbers, got {value!r}") from None
    if not np.isfinite(array).all():
        raise ConfigurationError(f"{name} must be finite, got {array}")
    return array


def finite_arrays(**values: ArrayLike) -> list[Array]:
    """The values as float64, broadcast together, in the order given.

    Raises:
        ConfigurationError: What is no number, or not finite, or shapes that do not broadcast.
    """
    arrays = [finite_array(name, value) for name, value in values.items()]
    try:
        return list(np.broadcast_arrays(*arrays))
    except ValueError:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in zip(values, arrays, strict=True))
        raise ConfigurationError(f"expected shapes that broadcast together, got {shapes}") from None
