"""HeadingDriveClearance: keep the stopping path of a robot that is driven along its heading out of discs."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from safe_wrappers.constraints.backup.base import DetourClearance
from safe_wrappers.constraints.obstacles import Disc, Discs, obstacles_from
from safe_wrappers.control.backup import drive_among_discs as among
from safe_wrappers.control.backup.heading_drive import Motion, path_corners, stopping_path
from safe_wrappers.control.numerics.shapes import nearest_discs
from safe_wrappers.errors import Array, ConfigurationError, check_fields, non_negative
from safe_wrappers.filter.constraint import HalfSpaces
from safe_wrappers.plants.mujoco.planar_robot import PlanarFrame, heading_drive
from safe_wrappers.plants.mujoco.plant import require_mujoco
from safe_wrappers.plants.plant import Plant, Trajectory


@dataclass
class HeadingDriveClearance(DetourClearance):
    """Keep the stopping path of a planar robot out of every disc.

    The robot slides on two joints with equal damping, turns on a hinge, and its drive pushes along the heading only.
    The backup manoeuvre brakes along the heading and holds it; clearance is counted from the area that it sweeps
    until rest (`control/backup/heading_drive.py`). A control is admitted if one control step of it uses up at most
    half of the clearance; within 2 mm of a disc its physics steps, and the backup's until rest, are predicted too.

    Proved: from a safe state the backup is admissible, for any number of discs, and the discs stay clear at every
    physics substep, while mass and damping are right to within `uncertainty`, the measured position to within
    `state_error`, discs stand still and nothing hits the robot. A motion that is faster than the actuators make it
    is reported as unsafe.

    Args:
        obstacles: `Disc` and `Discs`; they stand still.
        body: Name of the robot's body.
        margin: Fixed protective distance, m.
        state_error: Bound on the error of the measured position, m.
        uncertainty: Relative uncertainty of mass and of damping, in [0, 1).
        detour: When a driving action is refused, first try the same drive while turning towards the nearer tangent of
            the disc in the way, then turning alone; both only if admitted. No safety measure.
    """

    obstacles: Sequence[Any]
    body: str = "agent"
    margin: float = 0.002
    state_error: float = 0.0
    uncertainty: float = 0.0
    detour: bool = False

    promise = "proved"
    detour_steps: ClassVar[int] = 50

    def __post_init__(self) -> None:
        self.obstacles = obstacles_from(self.obstacles, kinds=(Disc, Discs))
        check_fields(self, non_negative, ("margin", "state_error"), "m")
        self.uncertainty = non_negative("uncertainty", self.uncertainty, "a fraction")
        if self.uncertainty >= 1.0:
            raise ConfigurationError(f"uncertainty is a fraction in [0, 1), got {self.uncertainty}")

    def setup(self, plant: Plant) -> None:
        hint = "HeadingDriveClearance needs a MujocoPlant: it reads the robot's model"
        machine = require_mujoco(plant, hint)
        machine.named("body", self.body, "body")
        self.frame = PlanarFrame(machine, self.body)
        self._discs = np.zeros((0, 3))
        self.turns_first = self.frame.turn_index == 0
        super().setup(machine)
        # The drive, and the bodies at the corners of its uncertainty: each must keep what is needed.
        self.drive = heading_drive(self.plant, self.body, self.uncertainty)
        self.models = np.array([self.drive, *self.drive.corners()], dtype=np.float64)
        scene = self.models, np.zeros(6), np.ones((1, 3)), self.reserve
        among.is_admitted(scene, 0.0, 0.0)  # compiled here, and not in a step
        among.secants(scene)
        among.way_around(scene, 0.0, 0.0, 0.0)
        among.manoeuvre_drive(scene)

    def clearance(self) -> Array:
        """Of the stopping path from the nearest disc, margin and state error not taken off, m, shape (1,)."""
        self._scene = self.models, np.empty(6), self.discs(), self.reserve
        qpos, qvel, place = self.plant.qpos, self.plant.qvel, self.frame.place
        value, self._in_play = among.least_clearance(qpos, qvel, place, self._scene)
        return np.array([value])

    @property
    def reserve(self) -> float:
        """Margin and state error, m."""
        return float(self.margin + self.state_error)

    def discs(self) -> Array:
        """x, y and the distance to keep from there, margin and state error in it, m, shape (n, 3)."""
        centers = [obstacle.centers(self.plant)[:, :2] for obstacle in self.obstacles]
        counts = [len(group) for group in centers]
        if sum(counts) != len(self._discs):
            self._discs = np.zeros((sum(counts), 3))
            self._discs[:, 2] = np.repeat([o.radius + self.reserve for o in self.obstacles], counts)
        np.concatenate(centers, out=self._discs[:, :2])
        return self._discs

    def nearest(self, neighbours: int) -> Array:
        _, (x, y, heading, vx, vy, _), discs, *_ = self._scene
        return nearest_discs(discs, x, y, heading, vx, vy, neighbours)

    def _pair(self, control: Array) -> Array:
        """Drive and turn, shape (2,); the same swap leads back."""
        return control[::-1].copy() if self.turns_first else control

    def leaves_clear(self, control: Array) -> bool:
        if not self._in_play:
            return True
        drive, turn = self._pair(control).tolist()
        return among.is_admitted(self._scene, drive, turn)

    def rows(self) -> HalfSpaces:
        """Secants of the clearance after one hold, over the acting controls, one row per disc in play."""
        return self._half_spaces(*among.secants(self._scene))

    def _half_spaces(self, normals: Array, offsets: Array) -> HalfSpaces:
        return HalfSpaces(normals[:, ::-1].copy() if self.turns_first else normals, offsets)

    def points(self, path: Trajectory) -> Array:
        """Corners of the area that braking sweeps from here, m, shape (corners, 1, 2); the third is at rest."""
        return path_corners(stopping_path(self.drive, Motion(*self._scene[1].tolist())))[:, None]

    def proposals(self, control: Array | None) -> list[Array]:
        """Controls that lead around the disc in the way; of None, the first of the backup manoeuvre."""
        if control is None:
            return [self._backup()]
        if not self.detour:
            return []
        drive, turn = self._pair(control).tolist()
        side = among.way_around(self._scene, drive, turn, self._kept_side())
        if side == 0.0:
            return []
        self._keep_side(side)
        return [self._pair(np.array([ahead, side])) for ahead in (drive, 0.0)]

    def _backup(self) -> Array:
        """The control that never shrinks the clearance: brake along the heading, hold the heading.

        From inside a disc it drives out, whichever way is better.
        """
        return self._pair(np.array([among.manoeuvre_drive(self._scene), 0.0]))
