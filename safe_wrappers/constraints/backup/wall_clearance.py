"""WallClearance: keep a point mass on two axes out of walls, counting its whole braking path."""

import math
from dataclasses import dataclass

import numpy as np

from safe_wrappers.checks import Array, check_fields, non_negative, positive
from safe_wrappers.constraints.backup.base import BoundBackupClearance
from safe_wrappers.control.backup import point_decision
from safe_wrappers.control.backup.damped_axis import braking
from safe_wrappers.drawing.marks import THIN, Mark, ball, line
from safe_wrappers.filter.constraint import Constraint, HalfSpaces
from safe_wrappers.plants.mujoco.plant import MujocoPlant, require_mujoco
from safe_wrappers.plants.plant import Plant
from safe_wrappers.plants.queries.planar_point import planar_point, walls


@dataclass
class WallClearance(Constraint):
    """Keep a point mass that is pushed along two axes out of every wall of a maze (PointMaze).

    A control is admitted if, held for one control step and followed by full braking of each axis, it keeps the point
    clear of every fixed box of the MuJoCo model.

    Proved: from a safe state the point never touches a wall, at any substep or in between. The plant's mass, damping
    and gears must be the machine's, walls stand still, and `velocity_clip` is the env's. Under a plant's `delay_s`
    the state is predicted without the clip: proved up to that speed.

    Args:
        margin: Beyond the distance at which MuJoCo reports a contact, m; covers rounding and the position error.
        velocity_clip: Speed along each axis to which the env clips the motion at the start of every control step, m/s
            (PointMaze: 5). None: not known; covers every clip.

    Raises:
        UnsupportedEnvError: At binding: no `MujocoPlant`, no such point, or walls that are not boxes along x and y.

    Source: appendix "Relative degree and kinetic stopping insets", in two dimensions with box walls.

    Example:
        >>> import safe_wrappers as sw
        >>> walls = sw.constraints.WallClearance(margin=0.01, velocity_clip=5.0)
        >>> walls.promise
        'proved'
    """

    margin: float = 0.001
    velocity_clip: float | None = None

    promise = "proved"

    def __post_init__(self) -> None:
        self.margin = non_negative("margin", self.margin, "m")
        check_fields(self, positive, ("velocity_clip",), "m/s")


class BoundWallClearance(BoundBackupClearance, of=WallClearance):
    """WallClearance on a plant: the rules are in `control/backup/point_decision.py`."""

    spec: WallClearance
    plant: MujocoPlant

    def __init__(self, spec: WallClearance, plant: Plant) -> None:
        hint = "on an AnalyticPlant use Clearance([Box(...)], position=[0, 1], velocity=[2, 3], braking=...)"
        super().__init__(spec, require_mujoco(plant, f"WallClearance needs a MujocoPlant; {hint}"))

    def read_constants(self) -> None:
        clip = self.spec.velocity_clip
        self._point = point = planar_point(self.plant, math.inf if clip is None else clip)
        around, reach = walls(self.plant.model, point.body)
        self._room = room = reach + self.spec.margin
        known = clip is not None
        at = point.axes, point.origin, point.joints, point.actuators
        self._scene = point_decision.scene(*at, room, known, around)
        self._motion = np.zeros(4)

    def clearance(self) -> Array:
        """Distance of the braking path from touching a wall, margin not taken off, m, shape (1,); no walls: (0,)."""
        self._left = point_decision.room_left(self._scene, self.plant.qpos, self.plant.qvel, self._motion)
        return np.array([self._left + self.spec.margin] if len(self._scene[-1]) else [])

    def admits(self, control: Array) -> bool:
        return point_decision.is_admitted(self._scene, self._motion, self._left, control)

    def load(self) -> None:
        control = np.zeros(self.plant.model.nu)
        self.admits(control)
        self.candidates(control)

    def backup(self) -> Array:
        """The control that is always admitted: brake both axes. From outside it leads back inside."""
        pair = point_decision.backup_pair(self._scene, self._motion, self._left)
        return self._point.control(np.zeros(self.plant.model.nu), pair)

    def candidates(self, control: Array) -> list[Array]:
        """Admissible controls near a refused one, the nearest first: those that slide along the walls in its way."""
        pairs = point_decision.candidates(self._scene, self._motion, self._left, control)
        return [self._point.control(control, pair) for pair in pairs]

    def draw(self) -> list[Mark]:
        """The edges that the point may not cross, around every wall, and its way until rest under full braking."""
        x, y, vx, vy = self._motion.tolist()
        ways = braking(self._point.axes[0], x, vx), braking(self._point.axes[1], y, vy)
        longest = max(len(way) for way in ways)
        way = np.stack([np.pad(way, (0, longest - len(way)), mode="edge") for way in ways], axis=1)
        found = [*line("way", way, THIN), ball("way", way[-1], 3.0 * THIN)]
        for left, right, low, high in self._scene[-1] + self._room * np.array([-1.0, 1.0, -1.0, 1.0]):
            corners = [[left, low], [right, low], [right, high], [left, high]]
            found += line("limit", corners, THIN, closed=True)
        return found

    def rows(self) -> HalfSpaces:
        """Bounds on the control along x and y: a convex part of what is admitted, braking included."""
        pairs, offsets = point_decision.half_spaces(self._scene, self._motion, self._left)
        normals = np.zeros((len(offsets), self.plant.model.nu))
        normals[:, self._point.actuators] = pairs
        return HalfSpaces(normals, offsets)
