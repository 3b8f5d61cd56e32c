"""plain_numbers: what a user gave as numbers, as what JSON can hold."""

from typing import Any

import numpy as np


def plain_numbers(given: Any) -> Any:
    """Floats and lists of floats for arrays, tuples and NumPy's scalars; what is no number is left for the checks."""
    if given is None or isinstance(given, str):
        return given
    try:
        return np.asarray(given, dtype=np.float64).tolist()
    except (TypeError, ValueError):
        return given
