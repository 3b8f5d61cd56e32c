"""What is read from a MuJoCo model: named parts, fixed bodies, control ranges, the joint-space inertia."""

from fnmatch import fnmatchcase
from typing import Any, Self

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array
from safe_wrappers.errors import UnknownNameError

FREE, BALL, SLIDE, HINGE = (
    int(getattr(mujoco.mjtJoint, f"mjJNT_{kind}")) for kind in ("FREE", "BALL", "SLIDE", "HINGE")
)
SCALAR_JOINTS = SLIDE, HINGE
"""The kinds of joints with one position."""
AT_A_JOINT = int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)
"""The transmissions of actuators that act on one joint."""


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


def names(model: mujoco.MjModel, kind: str, pattern: str = "*") -> list[str]:
    """All names of a kind that match a shell pattern."""
    count = {"body": "nbody", "joint": "njnt", "actuator": "nu", "camera": "ncam"}.get(kind, f"n{kind}")
    every = (getattr(model, kind)(i).name for i in range(getattr(model, count)))
    return [n for n in every if n and fnmatchcase(n, pattern)]


class Frames(Remade):
    """Named frames of a machine: the body that carries each, and a view of its origin in the data."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._model, self._data = model, data
        self._known: dict[tuple[str, str], tuple[int, Array]] = {}
        self._jacobian: Array = np.zeros((3, model.nv))
        self._rate: Array = np.zeros((3, model.nv))

    def of(self, kind: str, name: str) -> tuple[int, Array]:
        """The body that carries a frame, and the frame's origin, shape (3,), m."""
        if (kind, name) not in self._known:
            handle = named(self._model, kind, name)
            body = handle if kind == "body" else int(getattr(self._model, f"{kind}_bodyid")[handle])
            positions = getattr(self._data, {"body": "xpos", "site": "site_xpos", "geom": "geom_xpos"}[kind])
            self._known[kind, name] = body, positions[handle]
        return self._known[kind, name]

    def jacobian(self, kind: str, name: str) -> tuple[Array, Array]:
        """The origin, and its Jacobian, shape (3, nv)."""
        body, p = self.of(kind, name)
        mujoco.mj_jac(self._model, self._data, self._jacobian, None, p, body)
        return p, self._jacobian

    def jacobian_rate(self, kind: str, name: str) -> Array:
        """The time derivative of the Jacobian, shape (3, nv)."""
        body, p = self.of(kind, name)
        mujoco.mj_jacDot(self._model, self._data, self._rate, None, p, body)
        return self._rate


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
    """Time derivative of the positions, shape (nq,)."""
    if model.nq == model.nv:
        return qvel.copy()
    rate = np.zeros(model.nq)
    for j in range(model.njnt):
        q, v = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
        kind = model.jnt_type[j]
        if kind == FREE:
            rate[q : q + 3] = qvel[v : v + 3]
            q, v = q + 3, v + 3
        if kind in (FREE, BALL):
            # Angular velocities of these joints are in the body's frame; mju_derivQuat wants the world's.
            turn = np.zeros(4)
            mujoco.mju_mulQuatAxis(turn, qpos[q : q + 4].copy(), qvel[v : v + 3].copy())
            rate[q : q + 4] = 0.5 * turn
        else:
            rate[q] = qvel[v]
    return rate
