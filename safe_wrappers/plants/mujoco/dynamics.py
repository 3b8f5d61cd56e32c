"""The equations of motion of a MuJoCo model, M qacc + h = B u + sum J_k' f_k, and what follows from them.

They hold with MuJoCo's own accelerations and forces, to rounding. The base may float (a free joint) or not. Contacts
are points: MuJoCo's torsional and rolling friction (condim 4 and 6) is in no force. MuJoCo's contacts are soft, and
its solver ignores the drift `dJ/dt qvel`. The drift here is that of the material points that touch at present; under
a round foot that rolls, such a point moves into the foot.
"""

import copy
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.control.bandwidth import modes
from safe_wrappers.control.legged import CentroidalMomentum, centroidal_momentum
from safe_wrappers.errors import Array, UnsupportedEnvError
from safe_wrappers.plants.mujoco.actuators import AffineActuators
from safe_wrappers.plants.mujoco.binding import refuse_mapped
from safe_wrappers.plants.mujoco.contacts import ContactReader, Contacts
from safe_wrappers.plants.mujoco.model import (
    AT_A_JOINT,
    SCALAR_JOINTS,
    control_range,
    fixed_bodies,
    inertia,
    kinematics,
)
from safe_wrappers.plants.mujoco.plant import MujocoPlant

_CONTACT = int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)  # this type and those above are contacts
LEFT_OVER: Final = 0.05
"""Share of a vibration's amplitude that may be left after a control interval for a rigid model to be good enough."""


class FloatingBaseTerms(NamedTuple):
    """The equations of motion at one state, with the k contacts of MuJoCo's solver.

    The bias has Coriolis, centrifugal and gravity forces, minus passive and applied forces, minus the actuators'
    forces at zero control, minus constraint forces other than contacts, as MuJoCo found them for the data's control.
    """

    inertia: Array  #: M with armature, shape (nv, nv)
    bias: Array  #: h, shape (nv,)
    actuation: Array  #: B, shape (nv, nu): generalised force per control, inside the actuators' force ranges
    contacts: Contacts
    jacobians: Array  #: of the pushed body's velocity at the point relative to the other's, shape (k, 3, nv)
    drift: Array  #: `dJ/dt qvel`, shape (k, 3), m/s^2


def equations_of_motion(
    model: mujoco.MjModel, data: mujoco.MjData, actuators: AffineActuators | None = None
) -> FloatingBaseTerms:
    """The terms at the state of the data, which are only read and must be up to date (`mj_forward`).

    Raises:
        UnsupportedEnvError: Something flexible is in contact, which has no body; or an actuator that is not affine in
            its control, which is not checked where `actuators` are given.
    """
    acts = AffineActuators(model) if actuators is None else actuators
    gain, _ = acts.gain_and_bias(data.actuator_length, data.actuator_velocity)
    actuation = np.array(acts.moment(data).T * gain)
    others = np.zeros(model.nv)  # generalised force of all constraints but the contacts
    if data.nefc:
        mujoco.mj_mulJacTVec(model, data, others, np.where(data.efc_type < _CONTACT, data.efc_force, 0.0))
    bias = actuation @ np.clip(data.ctrl, *control_range(model)) - data.qfrc_smooth - others
    reader = ContactReader(model)
    reader.read(data)
    contacts = reader.found()
    if (contacts.bodies == model.nbody).any():
        raise UnsupportedEnvError("something flexible is in contact, which has no body")
    fixed, (jac, dot) = fixed_bodies(model), np.zeros((2, 3, model.nv))
    jacobians, drift = np.zeros((len(contacts.point), 3, model.nv)), np.zeros((len(contacts.point), 3))
    for row, (point, bodies) in enumerate(zip(contacts.point, contacts.bodies.tolist(), strict=True)):
        for body, side in zip(bodies, (-1.0, 1.0), strict=True):
            if not fixed[body]:
                mujoco.mj_jac(model, data, jac, None, point, body)
                mujoco.mj_jacDot(model, data, dot, None, point, body)
                jacobians[row] += side * jac
                drift[row] += side * (dot @ data.qvel)
    return FloatingBaseTerms(inertia(model, data), bias, actuation, contacts, jacobians, drift)


class MomentumReader:
    """Computes the momentum of the moving bodies among those chosen, a mask of shape (nbody,), by MuJoCo's subtrees.

    With a chosen body all that hangs from it is chosen. Armature, of no body, is left out.
    """

    def __init__(self, model: mujoco.MjModel, chosen: NDArray[np.bool_]) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        moving = chosen & ~fixed_bodies(model)
        self._roots = np.flatnonzero(moving & ~moving[model.body_parentid] & (model.body_subtreemass > 0.0))

    def read(self, data: mujoco.MjData) -> CentroidalMomentum | None:
        """The momentum at the state of the data, which are only read; None where numbers are not finite."""
        model, own, roots = self._model, self._data, self._roots
        kinematics(model, data, own)
        mujoco.mj_subtreeVel(model, own)
        parts = own.subtree_com[roots], own.subtree_linvel[roots], own.subtree_angmom[roots]
        if not np.isfinite(parts).all():
            return None
        return centroidal_momentum(model.body_subtreemass[roots], *parts)


class InverseDynamics:
    """M q'' + bias at the joints of a plant's position servos, as if these followed their targets.

    Joints without a servo stand still where the env has them. What touches, and what limits joints, is left out.

    Args:
        plant: Bound; all its actuators are position servos on hinges or slides.

    Raises:
        UnsupportedEnvError: Other actuators, or actions that are not the model's controls.
    """

    def __init__(self, plant: MujocoPlant) -> None:
        refuse_mapped(plant.action_map, "a torque limit of position commands")
        self._plant = plant
        self._read_model()

    def _read_model(self) -> None:
        model, self._model_version = copy.copy(self._plant.model), self._plant.model_version
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        self._model, self._data = model, mujoco.MjData(model)
        joints = model.actuator_trnid[: model.nu, 0]
        for i, joint in enumerate(joints):
            on_joint = model.actuator_trntype[i] in AT_A_JOINT and model.jnt_type[joint] in SCALAR_JOINTS
            gain, bias = model.actuator_gainprm[i, 0], model.actuator_biasprm[i]
            if not (on_joint and gain > 0.0 and bias[1] == -gain and bias[0] == 0.0):
                raise UnsupportedEnvError(
                    f"actuator {model.actuator(i).name or i!r} is no position servo of a hinge or slide, so its "
                    "command tells no torque: limit velocity, acceleration and jerk"
                )
        self._at, self._dof = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        self._gear = model.actuator_gear[: model.nu, 0].copy()

    def torques(self, positions: Array, velocities: Array, accelerations: Array) -> Array:
        """N m (N for slides), all shape (k, m), by `mj_inverse`: passive forces of the joints are counted."""
        torques = np.zeros_like(positions)
        for i, data in enumerate(self._placed(positions)):
            data.qvel[:] = data.qacc[:] = 0.0
            data.qvel[self._dof] = velocities[i] / self._gear
            data.qacc[self._dof] = accelerations[i] / self._gear
            mujoco.mj_inverse(self._model, data)
            torques[i] = data.qfrc_inverse[self._dof]
        return torques

    def inertia(self, positions: Array) -> Array:
        """Of the driven joints per command, at positions (k, m), shape (k, m, m), kg m^2 (kg for slides)."""
        found = np.zeros((*positions.shape, positions.shape[1]))
        for matrix, data in zip(found, self._placed(positions), strict=True):
            mujoco.mj_fwdPosition(self._model, data)
            matrix[:] = inertia(self._model, data)[np.ix_(self._dof, self._dof)] / self._gear
        return found

    def _placed(self, positions: Array) -> Iterator[mujoco.MjData]:
        """The data at each of the positions of the servos' joints."""
        self._plant.observe()
        if self._plant.model_version != self._model_version:
            self._read_model()
        for position in positions:
            self._data.qpos[:] = self._plant.qpos
            self._data.qpos[self._at] = position / self._gear
            yield self._data


class RigidModelCheck(NamedTuple):
    """What `rigid_model_check` found of springs behind a motor; printed, it is the verdict."""

    resonances: tuple[float, ...]  #: of the springs, at the pose of the check, the slowest first, rad/s
    damping_ratios: tuple[float, ...]  #: of each of them, to first order in the damping
    control_dt: float  #: control interval of the env, s

    @property
    def boundary_layer_s(self) -> float:
        """Time constant with which the slowest vibration decays, s; infinite without damping, 0 without springs."""
        if not self.resonances:
            return 0.0
        slowest = min(w * z for w, z in zip(self.resonances, self.damping_ratios, strict=True))
        return 1.0 / slowest if slowest > 0.0 else np.inf

    @property
    def left_over(self) -> float:
        """Share of a vibration's amplitude that is left after one control interval."""
        return float(np.exp(-self.control_dt / self.boundary_layer_s)) if self.resonances else 0.0

    @property
    def rigid_is_good_enough(self) -> bool:
        """Whether every vibration is gone, but for 5 %, before the next command comes."""
        return self.left_over <= LEFT_OVER

    def __str__(self) -> str:
        """The verdict and why, in one sentence."""
        if not self.resonances:
            return "rigid model is good enough: no spring lies behind a motor"
        found = zip(self.resonances, self.damping_ratios, strict=True)
        rings = ", ".join(f"{w / (2.0 * np.pi):.3g} Hz (damping ratio {z:.2g})" for w, z in found)
        return (
            f"rigid model is {'' if self.rigid_is_good_enough else 'not '}good enough: {rings}; the slowest decay "
            f"takes {self.boundary_layer_s:.3g} s, and {self.left_over:.0%} of the amplitude is left after a control "
            f"interval of {self.control_dt:.3g} s"
        )


def rigid_model_check(env: gym.Env[Any, Any]) -> RigidModelCheck:
    """Whether a rigid model of a MuJoCo env is good enough, by its springs' vibrations at the present pose.

    A spring is a hinge or slide with stiffness that no actuator drives, with a driven joint before it on the way from
    the world. Inertia, stiffness and damping are linearised; servos on the motors count, gravity, contacts and joint
    limits do not.
    A rigid model is for motions that are much slower than the slowest vibration; one that is not gone when the next
    command comes is excited again and again.

    Args:
        env: Any with a MuJoCo model, after a reset or in the pose to be checked.

    Raises:
        UnsupportedEnvError: No MuJoCo model, or one that `MujocoPlant` does not handle.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> print(sw.plants.rigid_model_check(gym.make("FlexJointReach-v0")))  # doctest: +ELLIPSIS
        rigid model is not good enough: 10.1 Hz (damping ratio ...
    """
    plant = MujocoPlant()
    plant.bind(env)
    plant.observe()
    data, model = plant.forward(), plant.model
    moment = plant.actuators.moment(data)
    scalar = np.flatnonzero(np.isin(model.jnt_type, SCALAR_JOINTS))
    dofs = model.jnt_dofadr[scalar]
    springs, damping = np.zeros(model.nv), np.diag(model.dof_damping)
    springs[dofs] = model.jnt_stiffness[scalar]
    affine = (model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE))[: len(moment)]
    fed_back = -model.actuator_biasprm[: len(moment)] * affine[:, None]
    stiffness = np.diag(springs) + moment.T * fed_back[:, 1] @ moment
    damping = damping + moment.T * fed_back[:, 2] @ moment
    driven = np.asarray(moment.any(axis=0))
    behind = np.zeros(model.nv, dtype=bool)  # whether a driven joint is before it on the way from the world
    for dof, before in enumerate(model.dof_parentid):  # which is smaller
        behind[dof] = before >= 0 and (driven[before] or behind[before])
    springs *= behind & ~driven
    found = modes(inertia(model, data), stiffness, damping)
    stored = springs @ found.shapes**2  # twice the energy in the springs, at an amplitude of 1
    share = stored / np.where(found.resonances > 0.0, found.resonances, np.inf) ** 2
    # A spring beside servos may have most of no vibration's energy.
    chosen = (share > 0.0) & (share >= min(0.5, share.max(initial=0.0)))
    resonances, ratios = found.resonances[chosen].tolist(), found.damping_ratios[chosen].tolist()
    return RigidModelCheck(tuple(resonances), tuple(ratios), plant.control_dt)
