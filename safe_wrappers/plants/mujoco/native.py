"""MuJoCo's own C functions for compiled code: they take the addresses of models and data, as in `data._address`."""

import ctypes
from pathlib import Path
from typing import Any, Final

import mujoco

from safe_wrappers.control.numerics.compiled import IS_COMPILED

_FOLDER: Final = Path(mujoco.__file__).parent
_LIBRARY: Final = str(next(path for name in ("libmujoco.*", "mujoco.dll") for path in _FOLDER.glob(name)))
if IS_COMPILED:
    from llvmlite.binding import load_library_permanently  # type: ignore[import-untyped]
    from numba import types

    load_library_permanently(_LIBRARY)  # so that code that was cached finds the symbols


def _function(name: str, addresses: int) -> Any:
    """The function of that name, of so many addresses; what it returns is left."""
    if IS_COMPILED:
        return types.ExternalFunction(name, types.void(*[types.intp] * addresses))
    function = getattr(ctypes.CDLL(_LIBRARY), name)
    function.argtypes, function.restype = [ctypes.c_void_p] * addresses, None
    return function


mj_step: Final = _function("mj_step", 2)
mj_kinematics: Final = _function("mj_kinematics", 2)
