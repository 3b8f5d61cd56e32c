"""Driven wheels in a MuJoCo model: found by their joints' names, with their constants, motion and load."""

from collections.abc import Sequence

import mujoco
import numpy as np

from safe_wrappers.control.vehicle import Wheel
from safe_wrappers.errors import Array, ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants.mujoco.binding import refuse_mapped
from safe_wrappers.plants.mujoco.model import AT_A_JOINT, HINGE, inertia
from safe_wrappers.plants.mujoco.plant import MujocoPlant

_ROUND = [int(getattr(mujoco.mjtGeom, f"mjGEOM_{shape}")) for shape in ("SPHERE", "CYLINDER", "CAPSULE")]
_FIXED_GAIN, _NO_BIAS = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtBias.mjBIAS_NONE)
_FLAT = 1e-6  # level part of an axle's direction below which it has none


class DrivenWheels:
    """The wheels of a vehicle on level ground, on the named hinges of a bound plant.

    The radius is that of a sphere, cylinder or capsule of the wheel's body: the one named like the joint, else the
    first that can touch something. A positive joint rate rolls ahead.

    Attributes:
        wheel: Radius, inertia about the axle and damping in the plant's model.
        effect: Torque per control inside the actuators' clamps, shape (n, nu), N m.

    Raises:
        ConfigurationError: No names, a name twice, or no hinge with a round geom and actuators of its own.
        UnknownNameError: No joint of that name.
        UnsupportedEnvError: A wheel that a servo drives.
    """

    def __init__(self, plant: MujocoPlant, names: Sequence[str]) -> None:
        if isinstance(names, str) or not names or len(set(names)) != len(names):
            wanted = f"wheels is a list of joint names, each once, got {names!r}"
            raise ConfigurationError(f"{wanted}; the model has the joints {', '.join(plant.names('joint'))}")
        refuse_mapped(plant.action_map, "a slip limit")
        self.names, self._plant, m = list(names), plant, plant.model
        self._joints = np.array([plant.named("joint", name) for name in names])
        self.dofs = m.jnt_dofadr[self._joints]
        direct = np.isin(m.actuator_trntype, AT_A_JOINT)
        self._drives = direct & (m.actuator_trnid[:, 0] == self._joints[:, None])
        data = mujoco.MjData(m)
        mujoco.mj_forward(m, data)
        others = (plant.actuators.moment(data)[:, self.dofs].T != 0.0) & ~self._drives
        fit = (m.jnt_type[self._joints] == HINGE) & self._drives.any(axis=1) & ~others.any(axis=1)
        for name in np.array(names)[~fit].tolist():
            raise ConfigurationError(
                f"joint {name!r} is no driven wheel: a slip can be limited of a hinge that actuators of its own "
                "drive, and no others through a tendon or a site"
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
        about_axle = np.diag(inertia(m, data))[self.dofs]
        self.wheel = Wheel(m.geom_size[self._geoms, 0], about_axle, m.dof_damping[self.dofs])
        motors = (m.actuator_gaintype == _FIXED_GAIN) & (m.actuator_biastype == _NO_BIAS)
        for wheel, i in np.argwhere(self._drives & ~motors).tolist():
            raise UnsupportedEnvError(
                f"the actuator {m.actuator(i).name or self.names[wheel]!r} is a servo, whose torque follows the "
                "wheel and hides what the ground does: drive the wheel by a motor"
            )
        self.effect = np.asarray(self._drives * (m.actuator_gear[:, 0] * m.actuator_gainprm[:, 0]))

    def motion(self) -> tuple[Array, Array, Array]:
        """Of each wheel, shapes (n,): its rate about its axle, rad/s, positive ahead; its centre's speed, m/s.

        The speed is given along the wheel's heading, and to the left of it.
        """
        m, d = self._plant.model, self._plant.pose()
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


def _round_geom(plant: MujocoPlant, joint: int) -> int:
    m = plant.model
    name, body = m.joint(joint).name, int(m.jnt_bodyid[joint])
    found = [g for g in np.flatnonzero(m.geom_bodyid == body).tolist() if int(m.geom_type[g]) in _ROUND]
    # False sorts before True, and the order in the model decides the rest.
    found.sort(key=lambda g: (not (m.geom_contype[g] or m.geom_conaffinity[g]), m.geom(g).name != name))
    if not found:
        raise ConfigurationError(
            f"wheel {name!r} needs a radius, read from a geom of its body {m.body(body).name!r}, which has no "
            "sphere, cylinder or capsule"
        )
    return found[0]
