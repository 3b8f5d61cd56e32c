"""HeadingDriveClearance: keep the stopping path of a robot that is driven along its heading out of discs."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array, check_fields, non_negative
from safe_wrappers.constraints.backup.base import BoundDetourClearance, Detour
from safe_wrappers.constraints.obstacles import Disc, Discs, obstacle_marks, obstacles_from
from safe_wrappers.control.backup import drive_among_discs as among
from safe_wrappers.control.backup.heading_drive import Motion, path_corners, stopping_path
from safe_wrappers.control.numerics.shapes import nearest_discs
from safe_wrappers.drawing.marks import THIN, Mark, ball, line
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.constraint import Constraint, ConstraintBatch, HalfSpaces
from safe_wrappers.plants.mujoco.plant import MujocoPlant, require_mujoco
from safe_wrappers.plants.plant import Plant
from safe_wrappers.plants.queries.planar_robot import PlanarFrame, heading_drive


@dataclass
class HeadingDriveClearance(Constraint):
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

    def __post_init__(self) -> None:
        self.obstacles = obstacles_from(self.obstacles, kinds=(Disc, Discs))
        check_fields(self, non_negative, ("margin", "state_error"), "m")
        self.uncertainty = non_negative("uncertainty", self.uncertainty, "a fraction")
        if self.uncertainty >= 1.0:
            raise ConfigurationError(f"uncertainty is a fraction in [0, 1), got {self.uncertainty}")


class BoundHeadingDriveClearance(BoundDetourClearance, of=HeadingDriveClearance):
    """HeadingDriveClearance on a plant: the rules are in `control/backup/drive_among_discs.py`."""

    detour_steps = 50
    spec: HeadingDriveClearance
    plant: MujocoPlant

    def __init__(self, spec: HeadingDriveClearance, plant: Plant) -> None:
        hint = "HeadingDriveClearance needs a MujocoPlant: it reads the robot's model"
        machine = require_mujoco(plant, hint)
        machine.named("body", spec.body, "body")
        self.frame = PlanarFrame(machine, spec.body)
        self._discs = np.zeros((0, 3))
        self.turns_first = self.frame.turn_index == 0
        super().__init__(spec, machine)

    def read_constants(self) -> None:
        """The drive, and the bodies at the corners of its uncertainty: each must keep what is needed."""
        self.drive = heading_drive(self.plant, self.spec.body, self.spec.uncertainty)
        self.models = np.array([self.drive, *self.drive.corners()], dtype=np.float64)

    def clearance(self) -> Array:
        """Of the stopping path from the nearest disc, margin and state error not taken off, m, shape (1,)."""
        self._scene = self.models, np.empty(6), self.discs(), self.reserve
        qpos, qvel, place = self.plant.qpos, self.plant.qvel, self.frame.place
        value, self._in_play = among.least_clearance(qpos, qvel, place, self._scene)
        return np.array([value])

    @property
    def reserve(self) -> float:
        """Margin and state error, m."""
        return float(self.spec.margin + self.spec.state_error)

    def discs(self) -> Array:
        """x, y and the distance to keep from there, margin and state error in it, m, shape (n, 3)."""
        centers = [obstacle.centers(self.plant)[:, :2] for obstacle in self.spec.obstacles]
        counts = [len(group) for group in centers]
        if sum(counts) != len(self._discs):
            self._discs = np.zeros((sum(counts), 3))
            self._discs[:, 2] = np.repeat([o.radius + self.reserve for o in self.spec.obstacles], counts)
        np.concatenate(centers, out=self._discs[:, :2])
        return self._discs

    def nearest(self, neighbours: int) -> Array:
        _, (x, y, heading, vx, vy, _), discs, *_ = self._scene
        return nearest_discs(discs, x, y, heading, vx, vy, neighbours)

    def _pair(self, control: Array) -> Array:
        """Drive and turn, shape (2,); the same swap leads back."""
        return control[::-1].copy() if self.turns_first else control

    def admits(self, control: Array) -> bool:
        if not self._in_play:
            return True
        drive, turn = self._pair(control).tolist()
        return among.is_admitted(self._scene, drive, turn)

    def rows(self) -> HalfSpaces:
        """Secants of the clearance after one hold, over the acting controls, one row per disc in play."""
        return self._half_spaces(*among.secants(self._scene))

    def _half_spaces(self, normals: Array, offsets: Array) -> HalfSpaces:
        return HalfSpaces(normals[:, ::-1].copy() if self.turns_first else normals, offsets)

    def candidates(self, control: Array) -> list[Array]:
        """Controls that lead around the disc in the way, to be tried before a refused control is projected."""
        if not self.spec.detour:
            return []
        drive, turn = self._pair(control).tolist()
        side = among.way_around(self._scene, drive, turn, self._kept_side())
        if side == 0.0:
            return []
        self._keep_side(side)
        return [self._pair(np.array([ahead, side])) for ahead in (drive, 0.0)]

    def backup(self) -> Array:
        """The control that never shrinks the clearance: brake along the heading, hold the heading.

        From inside a disc it drives out, whichever way is better.
        """
        return self._pair(np.array([among.manoeuvre_drive(self._scene), 0.0]))

    def draw(self) -> list[Mark]:
        """The discs with what is kept free before them; the outline of the area that braking sweeps, and its end."""
        motion = Motion(*self._scene[1].tolist())
        path = stopping_path(self.drive, motion)
        corners = path_corners(path)
        found = obstacle_marks(self.spec.obstacles, self.plant, self.reserve, corners[0])
        return [*found, *line("way", corners, THIN, closed=True), ball("way", corners[2], 3.0 * THIN)]

    @classmethod
    def batch(cls, bound: Sequence[Self]) -> ConstraintBatch | None:
        return HeadingDriveBatch(bound) if all(b.plant.published() is not None for b in bound) else None

    def load(self) -> None:
        _ = self.plant.acting_range
        among.is_admitted(self._scene, 0.0, 0.0)
        among.secants(self._scene)
        among.way_around(self._scene, 0.0, 0.0, 0.0)
        among.manoeuvre_drive(self._scene)


class HeadingDriveBatch(ConstraintBatch):
    """The robots of n envs; positions and velocities are read from the envs' own data, without a delay.

    Args:
        bound: The constraint on every env's plant, all of one specification.
    """

    def __init__(self, bound: Sequence[BoundHeadingDriveClearance]) -> None:
        n = len(bound)
        self._bound = list(bound)
        self._sides, self._steps = np.zeros(n), np.zeros(n, dtype=np.int64)
        self._positions: list[Array] = [np.zeros(3)] * n
        self._velocities: list[Array] = [np.zeros(3)] * n
        self._joints, self._motions = np.zeros((2, 3 * n)), np.zeros((n, 6))
        self._origins = np.zeros((n, 2))
        self._counts: list[int] = []
        self._models = np.array([b.models for b in bound])

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        for i in range(len(self._bound)):  # a copy reads the data of the copied envs
            self.restart(i, self.memory(i))

    def restart(self, env: int, memory: Detour) -> None:
        bound = self._bound[env]
        self._positions[env], self._velocities[env] = bound.frame.views(bound.plant.published())
        self._origins[env] = bound.frame.place[2:]
        self._sides[env], self._steps[env] = memory

    def memory(self, env: int) -> Detour:
        return Detour(float(self._sides[env]), int(self._steps[env]))

    def judge(self, proposals: Array) -> tuple[Array, NDArray[np.bool_]]:
        self._observe()
        one, values, admitted = self._bound[0], np.empty(len(proposals)), np.empty(len(proposals), dtype=bool)
        pairs = np.ascontiguousarray(proposals[:, ::-1] if one.turns_first else proposals)
        scene = self._models, self._motions, self._discs, self._first, one.reserve
        among.admit_each(*scene, pairs, values, admitted)
        return values, admitted

    def executed(self, envs: NDArray[np.bool_]) -> None:
        self._steps[envs] -= 1

    def _observe(self) -> None:
        """Take the present motion of every robot, and its discs."""
        np.concatenate(self._positions, out=self._joints[0])
        np.concatenate(self._velocities, out=self._joints[1])
        self._motions[:] = self._joints.reshape(2, -1, 3).swapaxes(0, 1).reshape(-1, 6)
        self._motions[:, :2] += self._origins
        groups = [o.centers(b.plant)[:, :2] for b in self._bound for o in b.spec.obstacles]
        counts = [*map(len, groups)]
        if counts != self._counts:
            discs = [b.discs() for b in self._bound]
            self._counts, self._discs = counts, np.concatenate(discs)
            self._first = np.cumsum([0, *map(len, discs)])
        np.concatenate(groups, out=self._discs[:, :2])
