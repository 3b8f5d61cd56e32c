"""What lies under a wheel, a ground and discs of other grounds on it, and the force of a tyre on each.

The curve is Pacejka's Magic Formula without curvature (H. Pacejka, Tire and Vehicle Dynamics), of tyres on roads: a
robot's wheel has its own, to be measured.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import mujoco


@dataclass(frozen=True)
class MagicFormula:
    """Longitudinal friction over slip, `mu = D sin(C atan(B s))`; slips beyond 1 in size count as 1."""

    peak_friction: float  # D
    peak_slip: float  # where it is reached, in (0, 1)
    shape: float = 1.65  # C, in (1, 2): how far the curve falls beyond its peak

    @cached_property
    def stiffness(self) -> float:
        """B."""
        return math.tan(math.pi / (2.0 * self.shape)) / self.peak_slip

    def at(self, slip: float) -> float:
        """Coefficient, with the slip's sign; in plain numbers, because every wheel asks at every physics substep."""
        x = self.stiffness * max(-1.0, min(slip, 1.0))
        return self.peak_friction * math.sin(self.shape * math.atan(x))


MAGIC_FORMULA: Final = {
    "dry": MagicFormula(1.0, 0.14),
    "wet": MagicFormula(0.7, 0.12),
    "snow": MagicFormula(0.3, 0.15),
    "ice": MagicFormula(0.1, 0.10),
}
"""By ground; at slip 1 about two thirds of the peak remain."""
GROUNDS: Final = tuple(MAGIC_FORMULA)
"""Names of the grounds, from the best grip to the least."""


@dataclass(frozen=True)
class Patch:
    """A disc of another ground, one of `GROUNDS`; m."""

    ground: str
    center: tuple[float, float]
    radius: float


class Ground:
    """A field's grounds, `base` and patches, of which the later lies on top.

    They are asked point by point, in plain numbers, because every wheel asks at every physics substep.
    """

    def __init__(self, base: str, patches: Sequence[Patch]) -> None:
        self.base, self.patches = base, tuple(patches)
        self._discs = [(*p.center, p.radius**2, p.ground) for p in reversed(self.patches)]

    def at(self, x: float, y: float) -> str:
        """Name of the ground at a point, m."""
        for cx, cy, square, ground in self._discs:
            dx, dy = x - cx, y - cy
            if dx * dx + dy * dy <= square:
                return ground
        return self.base

    def curve_at(self, x: float, y: float) -> MagicFormula:
        """Traction curve at a point, m."""
        return MAGIC_FORMULA[self.at(x, y)]


SLOWEST: Final = 0.5
"""Speed below which slip counts against this speed, m/s: at rest there is no ratio."""


UPRIGHT: Final = 0.5
"""Cosine of the tilt from which on the chassis has rolled over, and a wheel does not roll."""


class Tyres:
    """The tyres of a model whose wheels are hinges; `wheels` are names of their joints, bodies and geoms.

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

        Slip along and across counts against one speed, the largest of the ground's, the rim's and `SLOWEST`. Both
        share one curve (a friction circle): a wheel that spins or locks loses its grip across, too. The force opposes
        the sliding, so that a tyre only ever takes energy away.
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
            over = 1.0 / max(abs(forward), abs(rim), SLOWEST)
            along, across = (rim - forward) * over, -sideways * over
            slips[i], slip = along, math.hypot(along, across)
            share = curve_at(x, y).at(slip) * loads[i] / slip if loads[i] > 0.0 and slip else 0.0
            along, across = share * along, share * across
            fx = along * left_y + across * left_x
            fy = across * left_y - along * left_x
            forces[body] = [fx, fy, 0.0, r * fy, -r * fx, 0.0]
        data.xfrc_applied[: self._n_bodies] = forces
