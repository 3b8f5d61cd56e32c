"""`compiled`: a function of numbers and arrays as machine code, or as the same Python where that is not possible.

One source serves both. Without fused operations, and with `math`'s own functions, both give the same bits; only
`math.hypot` differs, so use `hypot` of this module. The environment variable ``SAFE_WRAPPERS_COMPILED=0`` switches
machine code off. It is cached beside the sources, or in the user's cache where that folder is read-only.
"""

import math
import os
from collections.abc import Callable
from typing import Any, TypeVar

Function = TypeVar("Function", bound=Callable[..., Any])


def _compiler() -> Callable[..., Any] | None:
    if os.environ.get("SAFE_WRAPPERS_COMPILED", "1") == "0":
        return None
    try:
        import numba
    except ImportError:  # a Python or machine that it does not support yet
        return None
    return numba.njit


_COMPILE = _compiler()
IS_COMPILED = _COMPILE is not None
"""Whether `compiled` gives machine code in this process."""


def compiled(function: Function) -> Function:
    """Decorator: the function as machine code, if there is a compiler. Exceptions of divisions by zero do not occur.

    It may call only other compiled functions, `math`, and NumPy's plain indexing; tuples may be named.
    """
    if _COMPILE is None:
        return function
    options = {"error_model": "numpy", "nogil": True}
    try:
        return _COMPILE(cache=True, **options)(function)  # type: ignore[no-any-return]
    except RuntimeError:  # no folder to cache in
        return _COMPILE(**options)(function)  # type: ignore[no-any-return]


@compiled
def hypot(x: float, y: float) -> float:
    """Length of (x, y); unlike `math.hypot` the same bits in Python and in machine code."""
    return math.sqrt(x * x + y * y)
