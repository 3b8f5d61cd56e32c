"""HeadingDriveClearance: keep a robot that is driven along its heading out of discs, until it rests."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from safe_wrappers.constraints.detour import Detour
from safe_wrappers.control.backup.heading_drive import clearances, look, way_to_rest
from safe_wrappers.control.shapes import nearest_discs
from safe_wrappers.errors import (
    Array,
    ConfigurationError,
    check_fields,
    finite_array,
    non_negative,
)
from safe_wrappers.filter.constraint import HalfSpaces, Memory
from safe_wrappers.plants.mujoco.planar_robot import PlanarFrame, heading_drive
from safe_wrappers.plants.mujoco.plant import require_mujoco
from safe_wrappers.plants.plant import Model, Plant, Trajectory


@dataclass
class HeadingDriveClearance(Detour, Model):
    """Keep the turning axis of a planar robot, and its parts, out of discs until it rests.

    The robot slides on two joints with equal damping, turns on a hinge, and its drive pushes along the heading only.
    A trajectory is a control held for one control step, and then the backup until rest: brake along the heading, no
    turning (`control/backup/heading_drive.py`). h is its least distance to the discs at any physics substep.

    Proved: from a safe state the backup is admitted, for any number of discs, and the discs stay clear at every
    physics substep, while the model is right, the measured position is to within `state_error`, discs stand still and
    nothing hits the robot. Best effort with `uncertainty`: every executed control that is not flagged leads clear of
    the discs for each of the models at its corners, and for the model itself; that there is one at every step, and
    that models between them are safe, is tested and not proved.

    Args:
        obstacles: `Disc` and `Discs` for the axis; they stand still.
        body: Name of the robot's body.
        margin: Fixed protective distance, m.
        state_error: Bound on the error of the measured position, m.
        uncertainty: Relative uncertainty of mass and of damping, in [0, 1).
        detour: When a driving action is refused, first try the same drive while turning towards the nearer tangent of
            the disc in the way, then turning alone, then backing out; each only if admitted. No safety measure.
        untouched: `Disc` and `Discs` that no part of the robot may touch; they stand still.
        parts: Discs that cover the robot, for `untouched`: [how far ahead of the axis, radius], m.
    """

    obstacles: Sequence[Any] = ()
    body: str = "agent"
    margin: float = 0.002
    state_error: float = 0.0
    uncertainty: float = 0.0
    detour: bool = False
    untouched: Sequence[Any] = ()
    parts: Sequence[Sequence[float]] = ()

    smooth: ClassVar[bool] = False  # a speed servo chatters
    rounding = 1e-7  # braking is rounded to the action's dtype
    detour_steps: ClassVar[int] = 50

    def __post_init__(self) -> None:
        self._check_shared("obstacles", "untouched")
        if not (self.obstacles or self.untouched):
            raise ConfigurationError("give obstacles (for the axis) or untouched (for the robot's parts)")
        parts = finite_array("parts", self.parts)
        if bool(parts.size) != bool(self.untouched):
            raise ConfigurationError("untouched needs the robot's parts, and parts are for untouched alone")
        if parts.size and not (parts.ndim == 2 and parts.shape[1] == 2 and (parts[:, 1] > 0.0).all()):
            raise ConfigurationError(
                f"parts are [[ahead, radius], ...], m, radii above 0; got {self.parts!r}"
            )
        self.parts = parts.tolist()
        check_fields(self, non_negative, ("margin", "state_error"), "m")
        self.uncertainty = non_negative("uncertainty", self.uncertainty, "a fraction")
        if self.uncertainty >= 1.0:
            raise ConfigurationError(f"uncertainty is a fraction in [0, 1), got {self.uncertainty}")
        self.promise = "best effort" if self.uncertainty else "proved"

    def setup(self, plant: Plant) -> None:
        hint = "HeadingDriveClearance needs a MujocoPlant: it reads the robot's model"
        super().setup(require_mujoco(plant, hint))
        self.plant.named("body", self.body, "body")
        self._frame, self.drive = PlanarFrame(self.plant, self.body), heading_drive(self.plant, self.body)
        self.models = np.array([self.drive, *self.drive.corners(self.uncertainty)], dtype=np.float64)
        self._discs, self._shown = np.zeros((0, 4)), 0
        self._full = self.drive.drive_limit / self.drive.drive_gain
        # Compiled here, and not in a step.
        joints = np.zeros(self.plant.model.nq), np.zeros(self.plant.model.nv), self._frame.place
        look(self.models, *joints, self._discs, self.margin)
        clearances(self.models, np.zeros(6), 0.0, 0.0, self._discs, False)

    def observe(self, memory: Memory) -> None:
        super().observe(memory)
        plant, discs = self.plant, self._all_discs()
        self._now = look(self.models, plant.qpos, plant.qvel, self._frame.place, discs, self.margin)
        self._least = self._now.clearances[0].min(initial=np.inf)

    def _all_discs(self) -> Array:
        """Of each disc the centre, the radius with the state error in it, and where it counts, m, shape (n, 4)."""
        pairs = [(o, 0.0, 0.0) for o in self.obstacles]
        pairs += [(o, radius, ahead) for ahead, radius in self.parts for o in self.untouched]
        centers = [obstacle.centers(self.plant)[:, :2] for obstacle, _, _ in pairs]
        counts = [len(group) for group in centers]
        if sum(counts) != len(self._discs):
            self._discs = np.zeros((sum(counts), 4))
            self._discs[:, 2] = np.repeat(
                [o.radius + more + self.state_error for o, more, _ in pairs], counts
            )
            self._discs[:, 3] = np.repeat([ahead for _, _, ahead in pairs], counts)
            self._shown = sum(counts[: len(self.obstacles) + len(self.untouched)])  # the first part's, too
        np.concatenate(centers, out=self._discs[:, :2])
        return self._discs

    def rollout(self, control: Array | None, horizon: int = 1) -> Trajectory:
        """The robot's motion now and the control: where they lead is followed as far as `h_along` needs it."""
        return Trajectory(control, self._now.motion[None])

    def h_along(self, path: Trajectory) -> Array:
        """The least clearance until rest, and that at its end, m, shape (2, k): of each model, and each disc near."""
        now = self._now
        if path.control is None:
            return now.clearances
        if self._least - now.loss >= self.margin:
            return np.zeros((1, 0))
        drive, turn = self._pair(path.control).tolist()
        return clearances(self.models, now.motion, drive, turn, now.discs, bool(self._least < self.margin))

    def _pair(self, control: Array) -> Array:
        """Drive and turn, shape (2,); the same swap leads back."""
        return control[::-1].copy() if self._frame.turn_index == 0 else control

    def _left(self, drive: float, turn: float) -> Array:
        return self.h_along(self.rollout(self._pair(np.array([drive, turn]))))

    def rows(self) -> HalfSpaces | None:
        """Secants of the clearance over all controls, one per disc that one of them can come too near."""
        if not self.margin <= self._least < self.margin + self._now.loss:
            return None
        low, high = (self._pair(end).tolist() for end in self.plant.acting_range)
        brake = self._now.brake
        push = high[0] if brake <= 0.0 else low[0]
        ends = (brake, 0.0), (push, 0.0), (brake, low[1]), (brake, high[1])
        braking, pushing, right, left = (self._left(*pair)[0] - self.margin for pair in ends)
        by_drive, by_turn = (pushing - braking) / (push - brake), (left - right) / (high[1] - low[1])
        loses = braking + np.minimum(pushing - braking, 0.0) - 0.5 * np.abs(left - right) < 0.0
        normals = -np.column_stack([by_drive, by_turn])[loses]
        offsets = (np.maximum(braking, 0.0) - by_drive * brake)[loses]
        return HalfSpaces(normals[:, ::-1].copy() if self._frame.turn_index == 0 else normals, offsets)

    def nearest(self, neighbours: int) -> Array:
        x, y, heading, vx, vy, _ = self._now.motion.tolist()
        shown = self._discs[: self._shown, :3] + np.array([0.0, 0.0, self.margin])
        return nearest_discs(shown, x, y, heading, vx, vy, neighbours)

    def points(self, path: Trajectory) -> Array:
        """Where braking leads, m, shape (instants, 1, 2)."""
        return way_to_rest(self.drive, self._now.motion)[:, None]

    def proposals(self, control: Array | None) -> list[Array]:
        """Controls that lead around the disc in the way; of None, the first of the backup.

        From inside a disc or its margin the backup is the drive that ends farthest out, if it leads no deeper.
        """
        now = self._now
        if control is None:
            drives = [now.brake]
            if self._least < self.margin:
                ends = {
                    drive: self._left(drive, 0.0).min(axis=1)
                    for drive in (now.brake, self._full, -self._full)
                }
                drives = [drive for drive in ends if ends[drive][0] >= self._least - self.rounding] or drives
                drives.sort(key=lambda drive: -ends[drive][1])
            return [self._pair(np.array([drives[0], 0.0]))]
        drive, turn = self._pair(control).tolist()
        if not (self.detour and drive):
            return []
        side = self._kept_side() or self._side_of_the_nearest(drive, turn)
        if side == 0.0:
            return []
        self._keep_side(side)
        # Close to a disc even turning in place is refused: it swings the axis about the centre of mass.
        around = (drive, side), (0.0, side), (-drive, side), (-drive, 0.0)
        return [self._pair(np.array(pair)) for pair in around]

    def _side_of_the_nearest(self, drive: float, turn: float) -> float:
        """Where to pass the disc ahead that a control comes nearest: 1 on the left, -1 on the right; 0: none is."""
        left = self._left(drive, turn)[0].reshape(len(self.models), -1).min(axis=0)
        x, y, heading = self._now.motion[:3].tolist()
        ahead = np.copysign(1.0, drive) * np.array([np.cos(heading), np.sin(heading)])
        to = self._now.discs[:, :2] - [x, y]
        is_ahead = to @ ahead > 0.0
        if not is_ahead.any():
            return 0.0
        across = to[np.where(is_ahead, left, np.inf).argmin()] @ np.array([-ahead[1], ahead[0]])
        return 1.0 if across <= 0.0 else -1.0
