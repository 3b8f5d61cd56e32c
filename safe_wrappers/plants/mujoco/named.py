"""Bodies, sites, geoms, joints and actuators of a model by name."""

from fnmatch import fnmatchcase

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.errors import UnknownNameError

Array = NDArray[np.float64]


def named(model: mujoco.MjModel, kind: str, name: str) -> int:
    """The id of a body, site, geom, joint or actuator; an unknown name is refused with the list."""
    found = mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), name)
    if found < 0:
        raise UnknownNameError(f"the model has no {kind} {name!r}; it has: {', '.join(names(model, kind))}")
    return int(found)


def names(model: mujoco.MjModel, kind: str, pattern: str = "*") -> list[str]:
    """All names of a kind that match a shell pattern."""
    count = {"body": "nbody", "joint": "njnt", "actuator": "nu"}.get(kind, f"n{kind}")
    every = (getattr(model, kind)(i).name for i in range(getattr(model, count)))
    return [n for n in every if n and fnmatchcase(n, pattern)]


def frame(model: mujoco.MjModel, data: mujoco.MjData, kind: str, name: str) -> tuple[int, Array]:
    """The body that carries a named frame, and the frame's origin."""
    handle = named(model, kind, name)
    body = handle if kind == "body" else int(getattr(model, f"{kind}_bodyid")[handle])
    return body, getattr(data, {"body": "xpos", "site": "site_xpos", "geom": "geom_xpos"}[kind])[handle]
