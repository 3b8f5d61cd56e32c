"""A planar arm of two links with elastic joints: its constants and the energy of its vibration."""

import math
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

from safe_wrappers.checks import Array

MOTORS: Final = slice(0, None, 2)
"""The motors' coordinates; the model's are motor 0, spring 0, motor 1, spring 1."""
SPRINGS: Final = slice(1, None, 2)
"""The springs' coordinates."""


@dataclass(frozen=True, eq=False)
class FlexibleArm:
    """The constants of the planar two-link arm and its joints; the link angles are q0 and, relative to it, q1.

    Link inertia: M(q) = [[`inertia` + 2 `coupling` cos q1, `forearm` + `coupling` cos q1], [the same, `forearm`]].

    Attributes:
        inertia: kg m^2, both links about the base, the elbow at a right angle.
        coupling: kg m^2.
        forearm: kg m^2, the forearm about the elbow.
        lengths: Shape (2,), m.
        rotor_inertia: Reflected to the link side, shape (2,), kg m^2.
        stiffness: Shape (2,), N m/rad.
        motor_damping: Shape (2,), N m s/rad.
        joint_damping: Across the springs, shape (2,), N m s/rad.
    """

    inertia: float
    coupling: float
    forearm: float
    lengths: Array
    rotor_inertia: Array
    stiffness: Array
    motor_damping: Array
    joint_damping: Array

    @classmethod
    def of_model(cls, model: mujoco.MjModel) -> "FlexibleArm":
        """Read them from the model: the links' inertia from its mass matrix in two poses."""
        data = mujoco.MjData(model)
        found = []
        for angle in (0.0, math.pi / 2.0):
            data.qpos[:] = 0.0, 0.0, angle, 0.0
            mujoco.mj_forward(model, data)
            columns = np.zeros((model.nv, model.nv))
            for column, unit in zip(columns, np.eye(model.nv), strict=True):
                mujoco.mj_mulM(model, data, column, unit)
            found.append(columns[SPRINGS, SPRINGS])  # no rotor's inertia acts on the springs' coordinates
        straight, bent = found
        return cls(
            inertia=float(bent[0, 0]),
            coupling=float(straight[0, 1] - bent[0, 1]),
            forearm=float(bent[1, 1]),
            lengths=np.array([model.body("forearm").pos[0], model.site("fingertip").pos[0]]),
            rotor_inertia=model.dof_armature[MOTORS].copy(),
            stiffness=model.jnt_stiffness[SPRINGS].copy(),
            motor_damping=model.dof_damping[MOTORS].copy(),
            joint_damping=model.dof_damping[SPRINGS].copy(),
        )

    def link_inertia(self, q: Array) -> Array:
        """M at link angles, shape (..., 2); shape (..., 2, 2), kg m^2."""
        cos = self.coupling * np.cos(q[..., 1])
        side = self.forearm + cos
        rows = [self.inertia + 2.0 * cos, side, side, np.full_like(side, self.forearm)]
        return np.stack(rows, axis=-1).reshape(*side.shape, 2, 2)

    def link_bias(self, q: Array, q_dot: Array) -> Array:
        """Coriolis and centripetal torque C(q, q_dot) q_dot, shape (..., 2), N m; the arm is level."""
        sin = self.coupling * np.sin(q[..., 1])
        v0, v1 = q_dot[..., 0], q_dot[..., 1]
        return np.stack([-sin * v1 * (2.0 * v0 + v1), sin * v0 * v0], axis=-1)

    def fingertip(self, q: Array) -> Array:
        """Position of the fingertip at link angles, shape (..., 2), in the plane; shape (..., 2), m."""
        first, both = q[..., 0], q[..., 0] + q[..., 1]
        l0, l1 = self.lengths
        return np.stack(
            [l0 * np.cos(first) + l1 * np.cos(both), l0 * np.sin(first) + l1 * np.sin(both)], axis=-1
        )

    def vibration_energy(self, qpos: Array, qvel: Array, torque: Array) -> Array:
        """Boundary-layer energy, shape (...,), J, of states of shape (..., 4) with the motors' torque held.

        What would ring on if the torque stayed as it is: `flexible_joint.boundary_layer_energy`, which the
        tests compare it with, written out for two joints because every physics substep asks. With the rigid arm's
        acceleration a, from (M + J) a = u - h with u = torque - B motor speed and h the links' bias, the springs'
        quasi-steady torque is z0 = u - J a.
        """
        j0, j1 = self.rotor_inertia.tolist()
        k0, k1 = self.stiffness.tolist()
        b0, b1 = self.motor_damping.tolist()
        t0, t1 = torque.tolist()
        _, p0, q2, p1 = qpos.T
        v0, r0, v1, r1 = qvel.T
        elbow = q2 + p1
        cos, sin = self.coupling * np.cos(elbow), self.coupling * np.sin(elbow)
        n00, n01, n11 = j0 + self.inertia + 2.0 * cos, self.forearm + cos, j1 + self.forearm
        speed0, speed1 = v0 + r0, v1 + r1
        u0, u1 = t0 - b0 * v0, t1 - b1 * v1
        f0 = u0 + sin * speed1 * (2.0 * speed0 + speed1)
        f1 = u1 - sin * speed0 * speed0
        share = 1.0 / (n00 * n11 - n01 * n01)
        x0 = (
            k0 * p0 + u0 - j0 * share * (n11 * f0 - n01 * f1)
        )  # z0 - z, as the springs' angles are link - motor
        x1 = k1 * p1 + u1 - j1 * share * (n00 * f1 - n01 * f0)
        w0, w1 = j0 * r0, j1 * r1
        stored = x0 * x0 / k0 + x1 * x1 / k1
        moving = w0 * r0 + w1 * r1 - share * (n11 * w0 * w0 - 2.0 * n01 * w0 * w1 + n00 * w1 * w1)
        energy: Array = 0.5 * (stored + moving)
        return energy.T  # the first transpose turned all leading axes round
