"""HeadingDriveClearance: keep the stopping path of a robot that is driven along its heading out of discs."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from safe_wrappers.checks import check_fields, non_negative
from safe_wrappers.constraints.backup.base import BoundDetourClearance
from safe_wrappers.constraints.obstacles import Disc, Discs, obstacles_from
from safe_wrappers.control.backup.heading_drive import StoppingPath
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.constraint import Array, Constraint, HalfSpaces
from safe_wrappers.plants.mujoco.plant import MujocoPlant, require_mujoco
from safe_wrappers.plants.plant import Plant
from safe_wrappers.plants.queries.planar_robot import PlanarFrame, heading_drive

_Circle = tuple[float, float, float]
"""Centre x, y and the radius to keep out of, margins included, m."""
_RECOVERY_RATE = 1.0  # 1/s: an unsafe start must shrink its violation at least this fast, where the drive can
_DECAY_PER_HOLD = 0.5
"""The share of the clearance that one hold may use up: the discrete class-K decay, alpha times the hold."""
_ROW_SLACK = 0.02  # share of the needed clearance that prediction may miss of what the rows aimed at
_HAIR_M = 1e-7  # slack for a solver where the rows of two discs meet at one control
_RESERVE_M = 0.001  # kept free for what the closed form leaves out; only the backup may use it


@dataclass
class HeadingDriveClearance(Constraint):
    """Keep the stopping path of a planar robot out of every disc.

    The robot slides on two joints with equal damping, turns on a hinge, and its drive pushes along the heading only.
    The backup manoeuvre brakes along the heading and holds it; clearance is counted from the area that it sweeps
    until rest (`control/backup/heading_drive.py`), and never shrinks under it. A control is admitted if one control
    step of it uses up at most half of the clearance.

    Proved: from a safe state the backup is admissible, for any number of discs, and the discs stay clear at every
    physics substep, while mass and damping are right to within `uncertainty`, the measured position to within
    `state_error`, discs stand still and nothing hits the robot. `margin` covers what the closed form leaves out,
    under 2 mm for the Point robot.

    Args:
        obstacles: `Disc` and `Discs`; they stand still.
        body: Name of the robot's body.
        margin: Fixed protective distance, m.
        state_error: Bound on the error of the measured position, m.
        uncertainty: Relative uncertainty of mass and of damping, in [0, 1).
        brake: False: the backup coasts along the heading, too; it needs no drive, and more room.
        detour: When a driving action is refused, first try the same drive while turning towards the nearer tangent of
            the disc in the way, then turning alone; both only if admitted. No safety measure.
    """

    obstacles: Sequence[Any]
    body: str = "agent"
    margin: float = 0.002
    state_error: float = 0.0
    uncertainty: float = 0.0
    brake: bool = True
    detour: bool = False

    promise = "proved"

    def __post_init__(self) -> None:
        self.obstacles = obstacles_from(self.obstacles, kinds=(Disc, Discs))
        check_fields(self, non_negative, ("margin", "state_error"), "m")
        self.uncertainty = non_negative("uncertainty", self.uncertainty, "a fraction")
        if self.uncertainty >= 1.0:
            raise ConfigurationError(f"uncertainty is a fraction in [0, 1), got {self.uncertainty}")

    def bind(self, plant: Plant) -> "BoundHeadingDriveClearance":
        return BoundHeadingDriveClearance(self, plant)


class BoundHeadingDriveClearance(BoundDetourClearance):
    """HeadingDriveClearance on a plant."""

    detour_steps = 50
    spec: HeadingDriveClearance
    plant: MujocoPlant

    def __init__(self, spec: HeadingDriveClearance, plant: Plant) -> None:
        machine = require_mujoco(
            plant, "HeadingDriveClearance needs a MujocoPlant: it reads the robot's model"
        )
        self._frame = PlanarFrame(machine, spec.body)
        super().__init__(spec, machine)

    def read_constants(self) -> None:
        self.drive = drive = heading_drive(self.plant, self.spec.body, self.spec.uncertainty)
        # Predictions are made for the corners of the uncertainty: each must keep what is needed.
        self._models = drive.corners()
        self._swivel = 2.0 * abs(drive.com_offset)
        # The most that one hold's drive can add to the path; a turn and the way travelled depend on the speed.
        self._push = drive.fastest_change * (drive.control_dt + drive.coast_time)
        fastest_turn = min(drive.yaw_limit / max(drive.yaw_damping, 1e-12), math.pi / drive.control_dt)
        turn = drive.control_dt * fastest_turn
        self._per_speed = drive.control_dt + turn * drive.coast_time

    def clearance(self) -> Array:
        """Of the stopping path from the nearest disc, margin and state error not taken off, m, shape (1,)."""
        self._motion = motion = self._frame.motion(self.plant)
        self._path = path = self.drive.stopping_path(motion, self.spec.brake)
        self._backup: list[StoppingPath] = []
        speed = math.hypot(motion.vx, motion.vy) + abs(self.drive.com_offset * motion.yaw_rate)
        self._loss = self._push + speed * self._per_speed
        x, y, reserve = motion.x, motion.y, self.spec.margin + self.spec.state_error
        kept = path.radius + self._swivel
        bounds: list[tuple[float, _Circle]] = []
        best = math.inf
        for obstacle in self.spec.obstacles:
            room = obstacle.radius + reserve
            for center in obstacle.centers(self.plant).tolist():
                cx, cy = center[0], center[1]
                bound = math.hypot(cx - x, cy - y) - room - kept
                bounds.append((bound, (cx, cy, room)))
                # A position that is not a number may be anywhere: the clearance is then not a number either.
                best = best if bound == bound else math.nan
        bounds.sort()
        for bound, disc in bounds:
            if not bound < best:
                break
            best = min(best, self._to_disc(path, disc))
        self._least = best
        # Farther discs cannot come into play within one hold, whatever the control.
        cutoff = 2.0 * (self._loss + _RESERVE_M)
        self._close = [disc for bound, disc in bounds if bound < cutoff] if best < cutoff else []
        return np.array([best + self.spec.margin + self.spec.state_error])

    def _to_disc(self, path: StoppingPath, disc: _Circle) -> float:
        x, y, room = disc
        if path.spread:  # it may come to rest anywhere in the area
            return path.distance(x, y) - self._swivel - room
        return min(path.distance(x, y), path.end_distance(x, y) - self._swivel) - room

    def _needed(self, disc: _Circle, backup: StoppingPath) -> float:
        """The clearance that a control must leave of a disc, from inside the safe set: a share of today's."""
        now = max(self._to_disc(self._path, disc), 0.0)
        target = _RESERVE_M + (1.0 - _DECAY_PER_HOLD) * max(0.0, now - _RESERVE_M)
        # Never more than the backup manoeuvre leaves: it is what makes the constraint always feasible.
        return min(target, self._to_disc(backup, disc))

    def _needed_outside(self, backup: StoppingPath) -> float:
        """The least clearance of all discs that a control must leave, once one of them is lost."""
        # As much recovery as the drive can give here: across the heading it can give none.
        full = self.drive.drive_limit / self.drive.drive_gain
        best = max(self._least_after(full), self._least_after(-full), self._least_of(backup))
        return min(self._least * (1.0 - _RECOVERY_RATE * self.drive.control_dt), best)

    def _least_of(self, path: StoppingPath) -> float:
        return min(self._to_disc(path, disc) for disc in self._close)

    def _least_after(self, drive: float) -> float:
        return min(self._least_of(path) for path in self._after(drive, 0.0))

    def _backups(self) -> list[StoppingPath]:
        if not self._backup:
            self._backup = self._after(self._ends()[0], 0.0)
        return self._backup

    def _after(self, drive: float, turn: float) -> list[StoppingPath]:
        """The stopping paths at the end of a held control, one per model of the uncertainty."""
        path, motion, brake = self.drive.stopping_path, self._motion, self.spec.brake
        return [path(model.predict(motion, drive, turn), brake) for model in self._models]

    def admits(self, control: Array) -> bool:
        """Predict the held control step; its end must still have a safe stopping path."""
        if not self._close:
            return True
        paths = self._after(float(control[self._frame.drive_index]), float(control[self._frame.turn_index]))
        for path, backup in zip(paths, self._backups(), strict=True):
            if self._least < 0.0:  # recovering: a quarter of what the rows aim at will do
                if self._least_of(path) < 0.25 * self._needed_outside(backup) + 0.75 * self._least:
                    return False
                continue
            for disc in self._close:
                left = self._to_disc(path, disc)
                if left < self._loss and left < self._needed(disc, backup) * (1.0 - _ROW_SLACK):
                    return False
        return True

    def rows(self) -> HalfSpaces:
        """Secants of the clearance after one hold, over the acting controls, one row per disc in play."""
        k, t = self._frame.drive_index, self._frame.turn_index
        normals, offsets = [], []
        if self._close:
            braking, pushing = self._ends()
            probes = (self._after(pushing, 0.0), self._after(braking, 1.0), self._after(braking, -1.0))
            for base, pushed, left, right in zip(self._backups(), *probes, strict=True):
                for clearance, needed in self._asked(base):
                    at_brake = clearance(base)
                    by_drive = (clearance(pushed) - at_brake) / (pushing - braking)
                    by_turn = 0.5 * (clearance(left) - clearance(right))
                    worst = at_brake + min(0.0, by_drive * (pushing - braking)) - abs(by_turn)
                    if worst >= needed:
                        continue
                    normal = np.zeros(self.plant.model.nu)
                    normal[k], normal[t] = -by_drive, -by_turn
                    normals.append(normal)
                    offsets.append(at_brake - by_drive * braking - needed + _HAIR_M)
        if not normals:
            return HalfSpaces.none(self.plant.model.nu)
        return HalfSpaces(np.array(normals), np.array(offsets))

    def _asked(self, backup: StoppingPath) -> list[tuple[Callable[[StoppingPath], float], float]]:
        """The clearances that count, as functions of the path, and what is needed of each."""
        if self._least < 0.0:
            return [(self._least_of, self._needed_outside(backup))]
        return [(partial(self._to_disc, disc=disc), self._needed(disc, backup)) for disc in self._close]

    def _ends(self) -> tuple[float, float]:
        """The drive controls that brake and that push on, as far as the drive acts."""
        m = self._motion
        ahead = m.vx * math.cos(m.heading) + m.vy * math.sin(m.heading)
        full = self.drive.drive_limit / self.drive.drive_gain
        braking = self.drive.brake_control(ahead) if self.spec.brake else 0.0
        return braking, math.copysign(full, ahead)

    def candidates(self, control: Array) -> list[Array]:
        """Controls that lead around the disc in the way, to be tried before a refused control is projected."""
        if not self.spec.detour:
            return []
        k, t = self._frame.drive_index, self._frame.turn_index
        drive = float(control[k])
        if not self._close or drive == 0.0:
            return []
        m = self._motion
        ahead, beside = math.cos(m.heading), math.sin(m.heading)
        if drive < 0.0:
            ahead, beside = -ahead, -beside
        in_front = [d for d in self._close if (d[0] - m.x) * ahead + (d[1] - m.y) * beside > 0.0]
        if not in_front:
            return []  # driving away from all of them: nothing to go around

        def beside_the_nearest() -> float:
            path = self._after(drive, float(control[t]))[0]
            x, y, _ = min(in_front, key=lambda disc: self._to_disc(path, disc))
            # A disc to the right of the drive is passed on the left.
            return 1.0 if ahead * (y - m.y) - beside * (x - m.x) <= 0.0 else -1.0

        around = np.array(control)
        around[t] = self._side(beside_the_nearest)
        turn_only = np.array(around)
        turn_only[k] = 0.0
        return [around, turn_only]

    def backup(self) -> Array:
        """The control that never shrinks the clearance: brake along the heading, hold the heading.

        From inside a disc it drives out, whichever way is better.
        """
        control = np.zeros(self.plant.model.nu)
        drive = self._ends()[0]
        if self._least < 0.0:
            full = self.drive.drive_limit / self.drive.drive_gain
            drive = max((drive, full, -full), key=lambda d: self._least_after(d))
        control[self._frame.drive_index] = drive
        return control
