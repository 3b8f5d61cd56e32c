"""What is read from a MuJoCo model: named parts, fixed bodies, control ranges, the joint-space inertia."""

import operator
from collections.abc import Sequence
from typing import Any, Final, Self

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.errors import Array, UnknownNameError

FREE, BALL, SLIDE, HINGE = (
    int(getattr(mujoco.mjtJoint, f"mjJNT_{kind}")) for kind in ("FREE", "BALL", "SLIDE", "HINGE")
)
SCALAR_JOINTS = SLIDE, HINGE
"""The kinds of joints with one position."""
_ALONG_S = 1e-5
AT_A_JOINT = int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)
"""The transmissions of actuators that act on one joint."""

RESETS = slice(int(mujoco.mjtWarning.mjWARN_BADQPOS), int(mujoco.mjtWarning.mjWARN_BADQACC) + 1)
"""The warnings after which MuJoCo resets the state."""


class Remade:
    """Base of what keeps addresses or views of MuJoCo's memory: a copy is made anew, from copies of the arguments."""

    def __new__(cls, *arguments: Any) -> Self:
        """Remember the arguments."""
        made = super().__new__(cls)
        made._arguments = arguments
        return made

    _arguments: tuple[Any, ...]

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), self._arguments


def named(model: mujoco.MjModel, kind: str, name: str, argument: str = "") -> int:
    """The id of a body, site, geom, joint, actuator or camera; for an unknown name an error that lists all.

    The error also says which `argument` has the name, where the caller may have left that at its default.
    """
    found = mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), name)
    if found < 0:
        known = ", ".join(names(model, kind)) or "none"
        how = f"; give another by {argument}=" if argument else ""
        raise UnknownNameError(f"the model has no {kind} {name!r}{how}; it has: {known}")
    return int(found)


def names(model: mujoco.MjModel, kind: str) -> list[str]:
    """All names of a kind."""
    count = {"body": "nbody", "joint": "njnt", "actuator": "nu", "camera": "ncam"}.get(kind, f"n{kind}")
    every = (getattr(model, kind)(i).name for i in range(getattr(model, count)))
    return [n for n in every if n]


def frame(
    model: mujoco.MjModel, data: mujoco.MjData, kind: str, name: str, compute: Any = mujoco.mj_jac
) -> tuple[Array, Array]:
    """Origin of a "body", "site" or "geom", shape (3,), m, and its Jacobian, or by `mj_jacDot` its rate, (3, nv)."""
    i = named(model, kind, name)
    body = i if kind == "body" else int(getattr(model, f"{kind}_bodyid")[i])
    origin = getattr(data, "xpos" if kind == "body" else f"{kind}_xpos")[i].copy()
    jacobian = np.zeros((3, model.nv))
    compute(model, data, jacobian, None, origin, body)
    return origin, jacobian


def fixed_bodies(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """Bodies with no joint between them and the world, mocap bodies among them, shape (nbody,).

    `body_weldid` is not enough: a mocap body is welded to the world (0) before MuJoCo 3.12, to itself from then on.
    """
    return np.asarray(model.body_dofnum[model.body_weldid] == 0)


def weight_n(model: mujoco.MjModel) -> float:
    """Weight of everything that moves, N; without gravity its mass in kg."""
    gravity = float(np.linalg.norm(model.opt.gravity))
    return float(model.body_mass[~fixed_bodies(model)].sum()) * (gravity or 1.0)


def control_range(model: mujoco.MjModel) -> tuple[Array, Array]:
    """Smallest and largest control, shapes (nu,): ctrlrange, or -inf and inf."""
    limited = model.actuator_ctrllimited.astype(bool)
    low = np.where(limited, model.actuator_ctrlrange[:, 0], -np.inf)
    return low, np.where(limited, model.actuator_ctrlrange[:, 1], np.inf)


def kinematics(model: mujoco.MjModel, data: mujoco.MjData, own: mujoco.MjData) -> None:
    """Compute poses and velocities at the state of the data in `own`; after a step those of the data may lag."""
    own.qpos[:], own.qvel[:] = data.qpos, data.qvel
    own.mocap_pos[:], own.mocap_quat[:] = data.mocap_pos, data.mocap_quat
    mujoco.mj_kinematics(model, own)
    mujoco.mj_comPos(model, own)
    mujoco.mj_comVel(model, own)


def inertia(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """Joint-space inertia with armature, shape (nv, nv), kg or kg m^2."""
    matrix, units = np.empty((model.nv, model.nv)), np.eye(model.nv)
    for i in range(model.nv):
        mujoco.mj_mulM(model, data, matrix[i], units[i])
    return matrix


def position_rate(model: mujoco.MjModel, qpos: Array, qvel: Array) -> Array:
    """Time derivative of the positions, shape (nq,): of orientations by central differences of MuJoCo's steps."""
    if model.nq == model.nv:
        return qvel.copy()
    ahead, behind = qpos.copy(), qpos.copy()
    mujoco.mj_integratePos(model, ahead, qvel, _ALONG_S)
    mujoco.mj_integratePos(model, behind, qvel, -_ALONG_S)
    return np.asarray((ahead - behind) / (2.0 * _ALONG_S))


_READ: Final = ("body_", "jnt_", "dof_", "geom_", "site_", "actuator_", "eq_", "tendon_", "pair_", "qpos")
_DRAWN: Final = ("_rgba", "_group", "_matid", "_user")
DYNAMICS: Final = (
    *("body_mass", "body_inertia", "body_ipos", "dof_armature", "dof_damping", "dof_frictionloss"),
    *("jnt_range", "jnt_stiffness", "geom_size", "geom_friction"),
    *("actuator_gear", "actuator_gainprm", "actuator_biasprm", "actuator_ctrlrange", "actuator_forcerange"),
)
"""What is compared at every step: masses, friction, joints and motors."""
PLACES: Final = ("body_pos", "geom_pos")
"""Likewise, where fixed bodies and geoms are."""


def fields_of(model: mujoco.MjModel) -> tuple[list[str], list[str]]:
    """The arrays that a plant or a constraint may read, without colours and names; the options of the physics."""
    read = [n for n in dir(model) if n.startswith(_READ) and not n.endswith(_DRAWN)]
    arrays = [n for n in read if isinstance(getattr(model, n), np.ndarray)]
    return arrays, [n for n in dir(model.opt) if not n.startswith("_")]


def different_fields(model: mujoco.MjModel, other: mujoco.MjModel) -> list[str]:
    """The arrays, and options of the physics, in which two models differ."""
    arrays, options = fields_of(model)
    of = [(n, model, other, n) for n in arrays] + [(f"opt.{n}", model.opt, other.opt, n) for n in options]
    return [shown for shown, one, two, n in of if not np.array_equal(getattr(one, n), getattr(two, n))]


def every_constant(model: mujoco.MjModel) -> "Constants":
    """All arrays of numbers, and all options."""
    return Constants(model, *fields_of(model))


class Constants(Remade):
    """Compares some arrays of a model with what they were, by their bytes.

    Args:
        model: Watched; it is not copied.
        fields: Names of its arrays.
        options: Names of options of the physics.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        fields: Sequence[str],
        options: Sequence[str] = ("timestep", "disableflags"),
    ) -> None:
        values = {name: getattr(model.opt, name) for name in options}
        arrays = [getattr(model, name) for name in fields]
        arrays += [value for value in values.values() if isinstance(value, np.ndarray)]
        numbers = [name for name, value in values.items() if not isinstance(value, np.ndarray)]
        self._options, self._numbers = model.opt, operator.attrgetter(*numbers)
        self._views = [array.reshape(-1).view(np.uint8).data for array in arrays if array.size]
        self._seen: Any = None
        self.changed()

    def changed(self) -> bool:
        """Whether they are not what they were when this was made, or at the last call."""
        before, self._seen = self._seen, (self._numbers(self._options), b"".join(self._views))
        return bool(before != self._seen)
