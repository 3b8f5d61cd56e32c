"""Arguments as arrays: finite numbers, of shapes that fit together, or an error that names them."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.errors import ConfigurationError

Array = NDArray[np.float64]


def finite_arrays(**values: ArrayLike) -> list[Array]:
    """The values as float64, broadcast together, in the order given.

    Raises:
        ConfigurationError: What is no number, or not finite, or shapes that do not broadcast.
    """
    arrays = []
    for name, given in values.items():
        try:
            array = np.asarray(given, dtype=np.float64)
        except (TypeError, ValueError):
            raise ConfigurationError(f"{name} is a number or an array of numbers, got {given!r}") from None
        if not np.isfinite(array).all():
            raise ConfigurationError(f"{name} must be finite, got {array}")
        arrays.append(array)
    try:
        return list(np.broadcast_arrays(*arrays))
    except ValueError:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in zip(values, arrays, strict=True))
        raise ConfigurationError(f"expected shapes that broadcast together, got {shapes}") from None
