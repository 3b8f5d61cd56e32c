"""What a whole-body problem needs of a MuJoCo model: M, h, B, the contacts, and the bodies' momentum.

    M qacc + h = B u + sum J_k' f_k

holds with MuJoCo's own accelerations and forces, to rounding. The base may float (a free joint) or not.

Contacts are points: what MuJoCo adds for torsional and rolling friction (condim 4 and 6) is in `moments` and in no
force. MuJoCo's contacts give way, and its solver asks for an acceleration `J qacc` of its own, without the drift
`dJ/dt qvel`. The drift here is that of the points of the bodies that touch just now: where a round foot rolls, that
point is drawn into the foot (by the square of the turning rate times the radius) while the contact lasts.
"""

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.errors import UnsupportedEnvError
from safe_wrappers.plants.mujoco.actuators import AffineActuators
from safe_wrappers.plants.mujoco.fixed_bodies import fixed_bodies

Array = NDArray[np.float64]

_CONTACT = int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)
"""The kinds of constraints from this one on are contacts."""


class ContactPoints(NamedTuple):
    """The contacts that MuJoCo's solver has, k of them.

    A contact's force acts on its `pushed` body, and against it on `pushed_by`. In a contact with the world, the world
    is never the pushed one.

    Attributes:
        points: Shape (k, 3), m.
        normals: Unit normals, pointing at the pushed body, shape (k, 3).
        first_tangents: The first axis of MuJoCo's friction pyramid, shape (k, 3).
        friction: Coefficient of sliding (MuJoCo's first), shape (k,); 0 where a contact has none (condim 1).
        pushed: Ids of bodies, shape (k,).
        pushed_by: Ids of bodies, shape (k,).
        jacobians: Of the pushed body's velocity at the point relative to the other's, shape (k, 3, nv).
        drift: `dJ/dt qvel`, shape (k, 3), m/s^2.
        forces: On the pushed body, as MuJoCo's solver found them last, shape (k, 3), N.
        moments: On the pushed body about the point, shape (k, 3), N m; 0 for condim 1 and 3.
        gaps: Signed distances, shape (k,), m; negative where bodies penetrate.
    """

    points: Array
    normals: Array
    first_tangents: Array
    friction: Array
    pushed: NDArray[np.intp]
    pushed_by: NDArray[np.intp]
    jacobians: Array
    drift: Array
    forces: Array
    moments: Array
    gaps: Array


class FloatingBaseTerms(NamedTuple):
    """The equations of motion at one state.

    Attributes:
        inertia: M with armature, shape (nv, nv).
        bias: h, shape (nv,): Coriolis, centrifugal and gravity forces, minus springs, damping and other passive
            forces, minus forces applied from outside (`qfrc_applied`, `xfrc_applied`), minus what actuators do at
            zero control (servos), minus constraint forces that are no contacts (joint limits, equalities, dry
            friction in joints). The last depend on the accelerations: they are those that MuJoCo found for the
            control that the data was made with.
        actuation: B, shape (nv, nu): generalised force per control (gain, gear, moment arm), inside the actuators'
            force ranges.
        contacts: See `ContactPoints`.
    """

    inertia: Array
    bias: Array
    actuation: Array
    contacts: ContactPoints


def equations_of_motion(
    model: mujoco.MjModel, data: mujoco.MjData, actuators: AffineActuators | None = None
) -> FloatingBaseTerms:
    """The same of any data, which must be up to date at its state (`mj_forward`).

    Args:
        model: The model.
        data: Is only read.
        actuators: Of the model; None makes them, which refuses actuators that are not affine.
    """
    acts = AffineActuators(model) if actuators is None else actuators
    inertia = np.empty((model.nv, model.nv))
    for row, unit in zip(inertia, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    gain, _ = acts.gain_and_bias(data.actuator_length, data.actuator_velocity)
    actuation = np.array(acts.moment(data).T * gain)
    limited = model.actuator_ctrllimited.astype(bool)
    low, high = model.actuator_ctrlrange.T
    acting = np.where(limited, np.clip(data.ctrl, low, high), data.ctrl)
    bias = actuation @ acting - data.qfrc_smooth - _other_constraints(model, data)
    return FloatingBaseTerms(inertia, bias, actuation, contact_points(model, data))


def contact_points(model: mujoco.MjModel, data: mujoco.MjData) -> ContactPoints:
    """The contacts of data that are up to date at its state (`mj_forward`).

    Raises:
        UnsupportedEnvError: Something flexible is in contact, which has no body.
    """
    touching = [i for i in range(data.ncon) if data.contact.efc_address[i] >= 0]
    fixed = fixed_bodies(model)
    k = len(touching)
    jacobians, drift = np.zeros((k, 3, model.nv)), np.zeros((k, 3))
    forces, moments, normals, first = (np.zeros((k, 3)) for _ in range(4))
    pushed, pushed_by = np.zeros(k, np.intp), np.zeros(k, np.intp)
    jac, dot, wrench = np.zeros((3, model.nv)), np.zeros((3, model.nv)), np.zeros(6)
    dim = data.contact.dim[touching]
    for row, i in enumerate(touching):
        geoms = data.contact.geom[i]
        if (geoms < 0).any():
            raise UnsupportedEnvError(
                "something flexible is in contact, which has no body that could be pushed"
            )
        one, other = (int(b) for b in model.geom_bodyid[geoms])
        # MuJoCo's normal points from the first geom to the second, and its force pushes the second.
        sign = 1.0
        if fixed[other]:
            one, other, sign = other, one, -1.0
        frame = data.contact.frame[i].reshape(3, 3)
        mujoco.mj_contactForce(model, data, i, wrench)
        normals[row], first[row] = sign * frame[0], frame[1]
        forces[row], moments[row] = sign * (wrench[:3] @ frame), sign * (wrench[3:] @ frame)
        pushed[row], pushed_by[row] = other, one
        for body, side in ((other, 1.0), (one, -1.0)):
            if fixed[body]:
                continue
            mujoco.mj_jac(model, data, jac, None, data.contact.pos[i], body)
            mujoco.mj_jacDot(model, data, dot, None, data.contact.pos[i], body)
            jacobians[row] += side * jac
            drift[row] += side * (dot @ data.qvel)
    return ContactPoints(
        points=np.array(data.contact.pos[touching]).reshape(k, 3),
        normals=normals,
        first_tangents=first,
        friction=np.where(dim > 1, data.contact.friction[touching, 0], 0.0).reshape(k),
        pushed=pushed,
        pushed_by=pushed_by,
        jacobians=jacobians,
        drift=drift,
        forces=forces,
        moments=moments,
        gaps=np.array(data.contact.dist[touching]).reshape(k),
    )


def _other_constraints(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """Generalised force of the constraints that are no contacts, shape (nv,)."""
    total = np.zeros(model.nv)
    if data.nefc:
        others = np.where(data.efc_type < _CONTACT, data.efc_force, 0.0)
        mujoco.mj_mulJacTVec(model, data, total, others)
    return total
