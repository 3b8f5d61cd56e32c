"""Driven wheels in a MuJoCo model: found by their joints' names, with their constants, motion and load."""

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from safe_wrappers.control.vehicle import Wheel
from safe_wrappers.errors import Array, ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants.mujoco.binding import refuse_mapped
from safe_wrappers.plants.mujoco.model import AT_A_JOINT, HINGE, inertia
from safe_wrappers.plants.mujoco.plant import MujocoPlant

_ROUND = [int(getattr(mujoco.mjtGeom, f"mjGEOM_{shape}")) for shape in ("SPHERE", "CYLINDER", "CAPSULE")]
_AFFINE_BIAS = int(mujoco.mjtBias.mjBIAS_AFFINE)
_FLAT = 1e-6  # level part of an axle's direction below which it has none


class DrivenWheels:
    """The wheels of a vehicle on level ground, on the named hinges of a bound plant.

    The radius is that of a sphere, cylinder or capsule of the wheel's body: the one named like the joint, else the
    first that can touch something. A positive joint rate rolls ahead.

    Attributes:
        feedback: Of the speed servos on each wheel, shape (n,), N m s/rad.

    Raises:
        ConfigurationError: No names, a name twice, or no hinge with a round geom and actuators of its own.
        UnknownNameError: No joint of that name.
    """

    def __init__(self, plant: MujocoPlant, names: Sequence[str]) -> None:
        if isinstance(names, str) or not names or len(set(names)) != len(names):
            wanted = f"wheels is a list of joint names, each once, got {names!r}"
            raise ConfigurationError(f"{wanted}; the model has the joints {', '.join(plant.names('joint'))}")
        self.names = list(names)
        refuse_mapped(plant.action_map, "a slip limit")
        m = plant.model
        self._joints = np.array([plant.named("joint", name) for name in names])
        for joint, name in zip(self._joints, names, strict=True):
            if m.jnt_type[joint] != HINGE:
                hinges = filter(None, (m.joint(j).name for j in np.flatnonzero(m.jnt_type == HINGE)))
                wanted = f"joint {name!r} is no hinge, so it is no wheel's axle"
                raise ConfigurationError(f"{wanted}; hinges are {', '.join(hinges)}")
        self.dofs = m.jnt_dofadr[self._joints]
        direct = np.isin(m.actuator_trntype, AT_A_JOINT)
        self._drives = direct & (m.actuator_trnid[:, 0] == self._joints[:, None])
        data = mujoco.MjData(m)
        mujoco.mj_forward(m, data)
        turns = plant.actuators.moment(data)[:, self.dofs].T != 0.0
        for drives, others, name in zip(self._drives, turns & ~self._drives, names, strict=True):
            if not drives.any():
                driven = sorted({m.joint(int(j)).name for j in m.actuator_trnid[direct, 0]})
                wanted = f"no actuator drives joint {name!r} directly, so its slip cannot be limited"
                raise ConfigurationError(f"{wanted}; driven are {', '.join(driven) or 'none'}")
            if others.any():  # `drive` does not model them
                found = ", ".join(m.actuator(int(i)).name or f"actuator #{i}" for i in np.flatnonzero(others))
                raise ConfigurationError(
                    f"joint {name!r} is also driven by {found} through a tendon or a site, which its slip limit "
                    "would not hold back; drive wheels by actuators on their own joints"
                )
        self._bodies = m.jnt_bodyid[self._joints]
        self._roots = m.body_rootid[self._bodies]
        self._geoms = np.array([_round_geom(plant, int(j)) for j in self._joints])
        # Contacts are read from the env, whose geoms may differ from the plant's. The last entry is for geom -1.
        truth: mujoco.MjModel = plant.attribute("model")
        self._wheel_of_geom = np.full(truth.ngeom + 1, -1)
        for i, body in enumerate(truth.jnt_bodyid[self._joints]):
            self._wheel_of_geom[:-1][truth.geom_bodyid == body] = i
        self._force = np.zeros(6)
        self.constants(plant)

    def constants(self, plant: MujocoPlant) -> Wheel:
        """Radius, inertia about the axle and damping in the plant's present model; also sets `feedback`."""
        m, data = plant.model, mujoco.MjData(plant.model)
        mujoco.mj_forward(m, data)
        # The torque of a servo that a forcerange may clamp counts as constant, not as feedback.
        servos = (m.actuator_biastype == _AFFINE_BIAS) & ~m.actuator_forcelimited.astype(bool)
        gear, about_axle = m.actuator_gear[:, 0], np.diag(inertia(m, data))[self.dofs]
        self._opposing = self._drives * np.where(servos, -gear * m.actuator_biasprm[:, 2], 0.0)
        self.feedback = np.asarray((self._opposing * gear).sum(axis=1))
        return Wheel(m.geom_size[self._geoms, 0], about_axle, m.dof_damping[self.dofs])

    def refuse_stiff_servos(self, plant: MujocoPlant) -> None:
        """Refuse a speed servo that settles sooner than the wheel's answer to a torque can be seen.

        Within a physics step; or, where its torque may be clamped and counts as constant, within a control step.
        Measured, with twice that: 40 to 99 % of harmless commands are changed.
        """
        m, inertias = plant.model, self.constants(plant).inertia
        for wheel, i in np.argwhere(self._drives & (m.actuator_biastype == _AFFINE_BIAS)):
            clamped, kv = bool(m.actuator_forcelimited[i]), -float(m.actuator_biasprm[i, 2])
            span_s = (plant.substeps if clamped else 1) * float(m.opt.timestep)
            share = float(m.actuator_gear[i, 0] ** 2) * kv * span_s / float(inertias[wheel])
            if share > 1.0:
                longest = "a control step (its torque is clamped)" if clamped else "a physics step"
                raise UnsupportedEnvError(
                    f"the speed servo {m.actuator(int(i)).name or self.names[wheel]!r} is too stiff for a slip "
                    f"limit: it settles within {longest}, so that its torque says nothing of the ground. Use a "
                    f"motor, or a kv of at most {0.99 * kv / share:.3g}"
                )

    def motion(self, plant: MujocoPlant) -> tuple[Array, Array, Array]:
        """Of each wheel, shapes (n,): its rate about its axle, rad/s, positive ahead; its centre's speed, m/s.

        The speed is given along the wheel's heading, and to the left of it.
        """
        m, d = plant.model, plant.pose()
        mujoco.mj_comPos(m, d)
        mujoco.mj_comVel(m, d)
        axle = d.xaxis[self._joints]
        level = np.hypot(axle[:, 0], axle[:, 1])
        level = np.where(level > _FLAT, level, np.inf)  # a wheel that lies flat does not roll
        ahead_x, ahead_y = axle[:, 1] / level, -axle[:, 0] / level
        turn, move = np.hsplit(d.cvel[self._bodies], 2)
        vx, vy, _ = (move + np.cross(turn, d.geom_xpos[self._geoms] - d.subtree_com[self._roots])).T
        return (turn * axle).sum(axis=1), ahead_x * vx + ahead_y * vy, ahead_x * vy - ahead_y * vx

    def loads(self, model: mujoco.MjModel, data: mujoco.MjData) -> Array:
        """Vertical force of the ground on each wheel, shape (n,), N, from an env's model and contacts."""
        loads = np.zeros(len(self.names))
        pairs = data.contact.geom
        for contact, wheel in enumerate(self._wheel_of_geom[pairs].max(axis=1, initial=-1).tolist()):
            if wheel >= 0:
                mujoco.mj_contactForce(model, data, contact, self._force)
                loads[wheel] += self._force[0] * abs(float(data.contact.frame[contact, 2]))
        return loads

    def torque(self, data: mujoco.MjData) -> Array:
        """Torque of the drives without `feedback`, shape (n,), N m, in an env's last physics substep."""
        return np.asarray(data.qfrc_actuator[self.dofs] + self._opposing @ data.actuator_velocity)

    def drive(self, plant: MujocoPlant) -> tuple[Array, Array]:
        """`torque = bias + effect @ u - feedback * rate` inside the actuators' clamps: (n,) in N m and (n, nu)."""
        m, driven = plant.model, self._drives
        gear = m.actuator_gear[:, 0]
        joint = np.where(driven.any(axis=0), m.actuator_trnid[:, 0], 0)
        length = gear * plant.qpos[m.jnt_qposadr[joint]]
        velocity = gear * plant.qvel[m.jnt_dofadr[joint]]
        gain, bias = plant.actuators.gain_and_bias(length, velocity)
        at_rest = (driven * (gear * bias)).sum(axis=1) + self._opposing @ velocity
        return np.asarray(at_rest), np.asarray(driven * (gear * gain))


def _round_geom(plant: MujocoPlant, joint: int) -> int:
    m = plant.model
    name, body = m.joint(joint).name, int(m.jnt_bodyid[joint])
    found = [g for g in np.flatnonzero(m.geom_bodyid == body).tolist() if int(m.geom_type[g]) in _ROUND]
    # False sorts before True, and the order in the model decides the rest.
    found.sort(key=lambda g: (not (m.geom_contype[g] or m.geom_conaffinity[g]), m.geom(g).name != name))
    radius = float(m.geom_size[found[0], 0]) if found else 0.0
    if not (math.isfinite(radius) and radius > 0.0):
        has = f"a radius of {radius} m" if found else "no sphere, cylinder or capsule"
        raise ConfigurationError(
            f"wheel {name!r} needs a radius above zero, read from a geom of its body {m.body(body).name!r}, which "
            f"has {has}"
        )
    return found[0]
