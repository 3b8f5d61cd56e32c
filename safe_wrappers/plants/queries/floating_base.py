"""The equations of motion of a MuJoCo model: M, h, B and the contacts.

    M qacc + h = B u + sum J_k' f_k

holds with MuJoCo's own accelerations and forces, to rounding. The base may float (a free joint) or not. Contacts are
points: MuJoCo's torsional and rolling friction (condim 4 and 6) is in no force. MuJoCo's contacts
are soft, and its solver ignores the drift `dJ/dt qvel`. The drift here is that of the material points that touch at
present; under a round foot that rolls, such a point moves into the foot.
"""

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array
from safe_wrappers.control.legged import CentroidalMomentum, centroidal_momentum
from safe_wrappers.errors import UnsupportedEnvError
from safe_wrappers.plants.mujoco.actuators import AffineActuators
from safe_wrappers.plants.mujoco.model import control_range, fixed_bodies, inertia, kinematics

_CONTACT = int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)  # this type and those above are contacts


class ContactPoints(NamedTuple):
    """The k contacts of MuJoCo's solver. The world is never the pushed body."""

    points: Array  #: shape (k, 3), m
    normals: Array  #: unit normals, pointing at the pushed body, shape (k, 3)
    first_tangents: Array  #: the first axis of MuJoCo's friction pyramid, shape (k, 3)
    friction: Array  #: coefficient of sliding (MuJoCo's first), shape (k,); 0 without friction (condim 1)
    pushed: NDArray[np.intp]  #: ids of the bodies, shape (k,)
    pushed_by: NDArray[np.intp]  #: ids of the other bodies, shape (k,)
    jacobians: Array  #: of the pushed body's velocity at the point relative to the other's, shape (k, 3, nv)
    drift: Array  #: `dJ/dt qvel`, shape (k, 3), m/s^2
    forces: Array  #: on the pushed body, as MuJoCo's solver found them last, shape (k, 3), N


class FloatingBaseTerms(NamedTuple):
    """The equations of motion at one state.

    The bias has Coriolis, centrifugal and gravity forces, minus passive and applied forces, minus the actuators'
    forces at zero control, minus constraint forces other than contacts, as MuJoCo found them for the data's control.
    """

    inertia: Array  #: M with armature, shape (nv, nv)
    bias: Array  #: h, shape (nv,)
    actuation: Array  #: B, shape (nv, nu): generalised force per control, inside the actuators' force ranges
    contacts: ContactPoints


def equations_of_motion(
    model: mujoco.MjModel, data: mujoco.MjData, actuators: AffineActuators | None = None
) -> FloatingBaseTerms:
    """The terms at the state of the data, which are only read and must be up to date (`mj_forward`).

    Raises:
        UnsupportedEnvError: An actuator that is not affine in its control; not checked where `actuators` are given.
    """
    acts = AffineActuators(model) if actuators is None else actuators
    gain, _ = acts.gain_and_bias(data.actuator_length, data.actuator_velocity)
    actuation = np.array(acts.moment(data).T * gain)
    others = np.zeros(model.nv)  # generalised force of all constraints but the contacts
    if data.nefc:
        mujoco.mj_mulJacTVec(model, data, others, np.where(data.efc_type < _CONTACT, data.efc_force, 0.0))
    bias = actuation @ np.clip(data.ctrl, *control_range(model)) - data.qfrc_smooth - others
    return FloatingBaseTerms(inertia(model, data), bias, actuation, contact_points(model, data))


def contact_points(model: mujoco.MjModel, data: mujoco.MjData) -> ContactPoints:
    """The contacts of data that are up to date (`mj_forward`).

    Raises:
        UnsupportedEnvError: Something flexible is in contact, which has no body.
    """
    touching, fixed = np.flatnonzero(data.contact.efc_address >= 0), fixed_bodies(model)
    k = len(touching)
    jacobians, drift = np.zeros((k, 3, model.nv)), np.zeros((k, 3))
    forces, normals, first = (np.zeros((k, 3)) for _ in range(3))
    pushed, pushed_by = np.zeros(k, np.intp), np.zeros(k, np.intp)
    jac, dot, wrench = np.zeros((3, model.nv)), np.zeros((3, model.nv)), np.zeros(6)
    dim = data.contact.dim[touching]
    for row, i in enumerate(touching):
        geoms = data.contact.geom[i]
        if (geoms < 0).any():
            raise UnsupportedEnvError("something flexible is in contact, which has no body")
        one, other = (int(b) for b in model.geom_bodyid[geoms])
        # MuJoCo's normal points from the first geom to the second, and its force pushes the second.
        sign = 1.0
        if fixed[other]:
            one, other, sign = other, one, -1.0
        frame = data.contact.frame[i].reshape(3, 3)
        mujoco.mj_contactForce(model, data, int(i), wrench)
        normals[row], first[row] = sign * frame[0], frame[1]
        forces[row] = sign * (wrench[:3] @ frame)
        pushed[row], pushed_by[row] = other, one
        for body, side in ((other, 1.0), (one, -1.0)):
            if fixed[body]:
                continue
            mujoco.mj_jac(model, data, jac, None, data.contact.pos[i], body)
            mujoco.mj_jacDot(model, data, dot, None, data.contact.pos[i], body)
            jacobians[row] += side * jac
            drift[row] += side * (dot @ data.qvel)
    points = np.array(data.contact.pos[touching]).reshape(k, 3)
    friction = np.where(dim > 1, data.contact.friction[touching, 0], 0.0).reshape(k)
    geometry = points, normals, first, friction, pushed, pushed_by
    return ContactPoints(*geometry, jacobians, drift, forces)


class MomentumReader:
    """Computes the momentum of the moving bodies among those chosen, a mask of shape (nbody,), by MuJoCo's subtrees.

    With a chosen body all that hangs from it is chosen. Armature, of no body, is left out.
    """

    def __init__(self, model: mujoco.MjModel, chosen: NDArray[np.bool_]) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        moving = chosen & ~fixed_bodies(model)
        roots = moving & ~moving[model.body_parentid] & (model.body_subtreemass > 0.0)
        self._roots = np.flatnonzero(roots)

    def read(self, data: mujoco.MjData) -> CentroidalMomentum | None:
        """The momentum at the state of the data, which are only read; None where numbers are not finite."""
        model, own, roots = self._model, self._data, self._roots
        kinematics(model, data, own)
        mujoco.mj_subtreeVel(model, own)
        parts = own.subtree_com[roots], own.subtree_linvel[roots], own.subtree_angmom[roots]
        if not all(np.isfinite(part).all() for part in parts):
            return None
        return centroidal_momentum(model.body_subtreemass[roots], *parts)
