"""MuJoCo's own C functions for compiled code: they take the addresses of models, data and arrays."""

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


def _function(name: str, kinds: str) -> Any:
    """The function of that name, of addresses (a), whole numbers (i) and numbers (d); what it returns is left."""
    if IS_COMPILED:
        known = {"a": types.intp, "i": types.intc, "d": types.double}
        return types.ExternalFunction(name, types.void(*[known[kind] for kind in kinds]))
    function = getattr(ctypes.CDLL(_LIBRARY), name)
    plain = {"a": ctypes.c_void_p, "i": ctypes.c_int, "d": ctypes.c_double}
    function.argtypes, function.restype = [plain[kind] for kind in kinds], None
    return function


mj_step: Final = _function("mj_step", "aa")
mj_kinematics: Final = _function("mj_kinematics", "aa")
mj_forwardSkip: Final = _function("mj_forwardSkip", "aaii")  # noqa: N816 - MuJoCo's name
mj_integratePos: Final = _function("mj_integratePos", "aaad")  # noqa: N816
mj_contactForce: Final = _function("mj_contactForce", "aaia")  # noqa: N816
mj_jac: Final = _function("mj_jac", "aaaaai")
mj_jacDot: Final = _function("mj_jacDot", "aaaaai")  # noqa: N816
mj_solveM: Final = _function("mj_solveM", "aaaai")  # noqa: N816
