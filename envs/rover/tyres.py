"""The forces of a rover's tyres: from the slip of each wheel, its load and the traction curve of the ground."""

import math
from collections.abc import Callable, Sequence
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..ground import MagicFormula
from ..tyre import tyre_force

UPRIGHT: Final = 0.5
"""Cosine of the tilt from which on the chassis has rolled over, and a wheel does not roll."""


def rolled_over(quaternion: NDArray[np.float64]) -> bool:
    """Whether a chassis with this orientation, shape (4,), lies on its side or its back."""
    _, x, y, _ = quaternion.tolist()
    return bool(1.0 - 2.0 * (x * x + y * y) < UPRIGHT)


class Tyres:
    """The tyres of a model whose wheels are hinges.

    Args:
        model: The model.
        wheels: Names of the wheels' joints, bodies and geoms.

    Attributes:
        bodies: Ids of the wheels' bodies.
        slips: Longitudinal slip of each wheel, as of the last `apply`.
    """

    def __init__(self, model: mujoco.MjModel, wheels: Sequence[str]) -> None:
        self._radius = float(model.geom(wheels[0]).size[0])
        self.bodies = [int(model.body(wheel).id) for wheel in wheels]
        self._joints = [int(model.joint(wheel).id) for wheel in wheels]
        self._n_bodies = max(self.bodies) + 1
        self._forces = [[0.0] * 6 for _ in range(self._n_bodies)]
        self.slips = [0.0] * len(wheels)

    def apply(self, data: mujoco.MjData, curve_at: Callable[[float, float], MagicFormula]) -> None:
        """Put every tyre's force on its wheel at the contact point, and keep the slips.

        Needs the kinematics of the present state (`mj_step1`). With z upwards, the contact point lies `r z` under the
        wheel's centre; its speed against the ground is the centre's plus that of the whole rotation of the wheel, the
        chassis's share included.
        """
        r = self._radius
        com_x, com_y, com_z = data.subtree_com[1].tolist()
        axes, centres = data.xaxis.tolist(), data.xanchor.tolist()
        velocities = data.cvel[: self._n_bodies].tolist()
        loads = data.userdata.tolist()
        forces, slips = self._forces, self.slips
        for i, (body, joint) in enumerate(zip(self.bodies, self._joints, strict=True)):
            left_x, left_y, _ = axes[joint]
            level = math.hypot(left_x, left_y)
            if level < UPRIGHT:  # it lies on its side: no heading, and no tread on the ground
                slips[i], forces[body] = 0.0, [0.0] * 6
                continue
            left_x, left_y = left_x / level, left_y / level
            x, y, z = centres[joint]
            wx, wy, wz, vx, vy, _ = velocities[body]  # as if it moved along at the whole's centre of mass
            vx += wy * (z - com_z) - wz * (y - com_y)
            vy += wz * (x - com_x) - wx * (z - com_z)
            rim = r * (wx * left_x + wy * left_y)
            forward = vx * left_y - vy * left_x
            sideways = vx * left_x + vy * left_y + r * (wx * left_y - wy * left_x)
            along, across, slips[i] = tyre_force(rim, forward, sideways, loads[i], curve_at(x, y))
            fx = along * left_y + across * left_x
            fy = across * left_y - along * left_x
            forces[body] = [fx, fy, 0.0, r * fy, -r * fx, 0.0]
        data.xfrc_applied[: self._n_bodies] = forces
