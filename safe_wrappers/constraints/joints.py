"""Which hinges and slides a constraint on joints means."""

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.mujoco import MujocoPlant

_HINGE_OR_SLIDE = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
_DRIVES = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))


def stops(model: mujoco.MjModel) -> tuple[list[int], NDArray[np.float64], NDArray[np.float64]]:
    """The driven hinges and slides that have a range, and its ends, rad or m."""
    driven = {
        int(model.actuator_trnid[a, 0]) for a in range(model.nu) if model.actuator_trntype[a] in _DRIVES
    }
    limited = [j for j in sorted(driven) if model.jnt_type[j] in _HINGE_OR_SLIDE and model.jnt_limited[j]]
    low, high = model.jnt_range[limited].T
    return limited, low, high


def scalar_joints(plant: MujocoPlant, names: Sequence[str] | None) -> list[int]:
    """Ids of the named joints, or of every hinge and slide that an actuator drives directly.

    Raises:
        ConfigurationError: A named joint is neither hinge nor slide, or no actuator drives one directly.
        UnknownNameError: No joint of that name.
    """
    model = plant.model
    if names is None:
        driven = {
            int(model.actuator_trnid[a, 0]) for a in range(model.nu) if model.actuator_trntype[a] in _DRIVES
        }
        ids = [j for j in sorted(driven) if model.jnt_type[j] in _HINGE_OR_SLIDE]
        if not ids:
            raise ConfigurationError(
                "no actuator drives a hinge or slide directly: name the joints; the model has: "
                + ", ".join(plant.names("joint"))
            )
        return ids
    ids = [plant.named("joint", name) for name in names]
    for j, name in zip(ids, names, strict=True):
        if model.jnt_type[j] not in _HINGE_OR_SLIDE:
            raise ConfigurationError(f"joint {name!r} is neither a hinge nor a slide")
    return ids
