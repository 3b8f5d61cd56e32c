"""`compiled`: a function of numbers and arrays as machine code, or as the same Python where that is not possible.

One source serves both. Without fused operations, and with `math`'s own functions, both give the same bits; only
`math.hypot` differs, so use `hypot` of this module. The environment variable ``SAFE_WRAPPERS_COMPILED=0`` switches
machine code off. It is cached beside the sources, or in the user's cache where that folder is read-only. Compiling
takes seconds: one line on stderr says so.
"""

import contextlib
import math
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

Function = TypeVar("Function", bound=Callable[..., Any])


_COMPILING = (
    "safe-wrappers: compiling for this machine, once (10 to 40 s); later starts load what is compiled"
)


def _compiler() -> Callable[..., Any] | None:
    """Numba's, which says once that it compiles functions of this package; None where it is off or not there."""
    if os.environ.get("SAFE_WRAPPERS_COMPILED", "1") == "0":
        return None
    try:
        import numba
        from numba.core import event
    except ImportError:  # a Python or machine that it does not support yet
        return None

    class Notice(event.Listener):
        written = False

        def on_start(self, event: Any) -> None:
            module = str(event.data["dispatcher"].py_func.__module__)
            if module.startswith("safe_wrappers.") and not self.written:
                self.written = True
                print(_COMPILING, file=sys.stderr, flush=True)

        def on_end(self, event: Any) -> None:
            """Nothing is said."""

    event.register("numba:compile", Notice())
    return numba.njit


def _drop_stale(function: Callable[..., Any]) -> None:
    """Delete cached code older than a source it may contain: the compiler looks at the function's own file only."""
    source = Path(function.__code__.co_filename)
    for index in (source.parent / "__pycache__").glob(f"{source.stem}.{function.__name__}-*.nbi"):
        with contextlib.suppress(OSError):  # another process was faster, or nothing may be written here
            if index.stat().st_mtime < _NEWEST_SOURCE_S:
                index.unlink()


_COMPILE = _compiler()
_NEWEST_SOURCE_S = max(source.stat().st_mtime for source in Path(__file__).parent.rglob("*.py"))
IS_COMPILED = _COMPILE is not None
"""Whether `compiled` gives machine code in this process."""


def compiled(function: Function) -> Function:
    """Decorator: the function as machine code, if there is a compiler. Exceptions of divisions by zero do not occur.

    It may call only other compiled functions, `math`, and NumPy's plain indexing; tuples may be named.
    """
    if _COMPILE is None:
        return function
    _drop_stale(function)
    options = {"error_model": "numpy", "nogil": True}
    try:
        return _COMPILE(cache=True, **options)(function)  # type: ignore[no-any-return]
    except RuntimeError:  # no folder to cache in
        return _COMPILE(**options)(function)  # type: ignore[no-any-return]


@compiled
def hypot(x: float, y: float) -> float:
    """Length of (x, y); unlike `math.hypot` the same bits in Python and in machine code."""
    return math.sqrt(x * x + y * y)
