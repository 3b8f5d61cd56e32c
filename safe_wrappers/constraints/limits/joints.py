"""Which hinges and slides a constraint on joints means."""

from collections.abc import Iterable, Sequence

import mujoco
import numpy as np

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.constraint import Array
from safe_wrappers.plants.mujoco.plant import MujocoPlant

HINGE_OR_SLIDE = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
_DRIVES = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))


def driven_joints(model: mujoco.MjModel) -> list[int]:
    """The hinges and slides that an actuator drives directly."""
    return [j for j in _direct(model) if model.jnt_type[j] in HINGE_OR_SLIDE]


def per_joint(name: str, given: float | Sequence[float], count: int) -> Array:
    """One value for all joints, or one for each, as an array of shape (count,)."""
    try:
        return np.broadcast_to(np.asarray(given, dtype=np.float64), (count,))
    except ValueError:
        raise ConfigurationError(f"expected one {name} or {count}, got {given}") from None


def _direct(model: mujoco.MjModel) -> list[int]:
    kinds = model.actuator_trntype
    return sorted({int(model.actuator_trnid[a, 0]) for a in range(model.nu) if kinds[a] in _DRIVES})


def refuse_uncovered(model: mujoco.MjModel, joints: Iterable[int], remedy: str, forces: bool = True) -> None:
    """Refuse to take the driven joints for all where an action moves others of these joints as well.

    It does where it is no force, pulls at a tendon or a site, or drives a ball joint. In other machines a joint that
    nothing drives is passive.

    Args:
        model: The machine's.
        joints: Ids of the joints in question.
        remedy: What to do instead, for the error's message.
        forces: Whether actions are forces; False: displacements.

    Raises:
        ConfigurationError: With the joints that would be covered, and those that would not.
    """
    covered = driven_joints(model)
    only_joints = bool(np.isin(model.actuator_trntype, _DRIVES).all()) and _direct(model) == covered
    rest = [j for j in joints if j not in covered]
    if rest and not (forces and only_joints):
        named = [", ".join(model.joint(j).name for j in ids) for ids in (covered, rest)]
        raise ConfigurationError(
            "an action of this machine may move more joints than those that an actuator drives directly. Covered "
            f"would be: {named[0]}. Not covered: {named[1]}. {remedy}"
        )


def stops(model: mujoco.MjModel) -> tuple[list[int], Array, Array]:
    """The driven hinges and slides that have a range, and its ends, rad or m."""
    limited = [j for j in driven_joints(model) if model.jnt_limited[j]]
    low, high = model.jnt_range[limited].T
    return limited, low, high


def refuse_uncovered_stops(model: mujoco.MjModel) -> None:
    """Refuse to guard the driven joints' stops where an action moves other joints that have some as well."""
    limited = np.flatnonzero(model.jnt_limited).tolist()
    refuse_uncovered(model, limited, "joint_tolerance=None leaves all joints alone")


def scalar_joints(plant: MujocoPlant, names: Sequence[str] | None) -> list[int]:
    """Ids of the named joints, or of every hinge and slide that an actuator drives directly.

    Raises:
        ConfigurationError: No hinge or slide is driven, an action moves others as well, or a named joint is neither.
        UnknownNameError: No joint of that name.
    """
    model = plant.model
    if names is None:
        ids = driven_joints(model)
        if not ids:
            raise ConfigurationError(
                "no actuator drives a hinge or slide directly: name the joints; the model has: "
                + ", ".join(plant.names("joint"))
            )
        # What flies freely is no joint of a machine.
        own = [j for j in range(model.njnt) if model.jnt_type[j] != int(mujoco.mjtJoint.mjJNT_FREE)]
        refuse_uncovered(model, own, "Name those that you mean: joints=[...]", plant.has_acceleration)
        return ids
    ids = [plant.named("joint", name) for name in names]
    for j, name in zip(ids, names, strict=True):
        if model.jnt_type[j] not in HINGE_OR_SLIDE:
            raise ConfigurationError(f"joint {name!r} is neither a hinge nor a slide")
    return ids
