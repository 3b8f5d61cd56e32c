"""WallClearance: keep a point mass on two axes out of walls, counting its whole braking path."""

import math
from dataclasses import dataclass

import numpy as np

from safe_wrappers.checks import check_fields, non_negative, positive
from safe_wrappers.constraints.backup.base import BoundBackupClearance
from safe_wrappers.control.backup.point_among_walls import PointAmongWalls, PointMotion
from safe_wrappers.control.numerics.rectangles import Rectangle, gaps, nearest
from safe_wrappers.filter.constraint import Array, Constraint, HalfSpaces
from safe_wrappers.plants.mujoco.plant import MujocoPlant, require_mujoco
from safe_wrappers.plants.plant import Plant
from safe_wrappers.plants.queries.planar_point import planar_point, walls

_Control = tuple[float, float]  # along x and along y, in the actuators' units

_HAIR_M = 1e-7  # extra distance of corrections, for rounding to float32
_NOISE_M = 1e-12  # rounding of float64 between a path and the rest of it
_RECOVERY_S = 0.1  # time constant, s, with which a violation must shrink from outside
_TURNS = 4  # how many walls, one after another, a correction may have to turn away from
_HALVINGS = 5  # steps that move a correction back towards the proposal where the path fits, not its rectangle


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

    def bind(self, plant: Plant) -> "BoundWallClearance":
        return BoundWallClearance(self, plant)


class BoundWallClearance(BoundBackupClearance):
    """WallClearance on a plant."""

    spec: WallClearance
    plant: MujocoPlant

    def __init__(self, spec: WallClearance, plant: Plant) -> None:
        hint = "on an AnalyticPlant use Clearance([Box(...)], position=[0, 1], velocity=[2, 3], braking=...)"
        super().__init__(spec, require_mujoco(plant, f"WallClearance needs a MujocoPlant; {hint}"))

    def read_constants(self) -> None:
        clip = self.spec.velocity_clip
        self._point = point = planar_point(self.plant, math.inf if clip is None else clip)
        around, reach = walls(self.plant.model, point.body)
        self._among = PointAmongWalls(*point.axes, around, clip is not None)
        self._room = reach + self.spec.margin

    def clearance(self) -> Array:
        """Distance of the braking path from touching a wall, margin not taken off, m, shape (1,); no walls: (0,)."""
        (i, j), (x, y), q, v = self._point.joints, self._point.origin, self.plant.qpos, self.plant.qvel
        motion = PointMotion(float(q[i]) + x, float(q[j]) + y, float(v[i]), float(v[j]))
        self._motion = self._among.clipped(motion)
        self._needed: float | None = None
        self._least = math.nan
        if math.isfinite(sum(motion)):
            self._least = self._among.distance(self._motion) - self._room
        self._inside = self._least >= -_HAIR_M
        return np.array([self._least + self.spec.margin] if self._among.walls else [])

    def admits(self, control: Array) -> bool:
        i, j = self._point.actuators
        return self._admitted((float(control[i]), float(control[j])))

    def _admitted(self, control: _Control, spare: float = 0.0) -> bool:
        if not self._inside:
            return self._left_after(control) >= self._recovery() - _NOISE_M
        # Rounding may have taken a hair of the room: braking, which takes nothing, is admitted all the same.
        needed = spare if spare > 0.0 else min(0.0, self._least) - _NOISE_M
        return self._among.clear(self._motion, *control, self._room + needed)

    def _left_after(self, control: _Control) -> float:
        """What is left after a control step, its own way not counted: it starts outside."""
        return self._among.distance(self._among.step(self._motion, *control)) - self._room

    def _recovery(self) -> float:
        """What a control must leave from outside the safe set."""
        if self._needed is None:
            axis = self._among.x_axis
            target = self._least * math.exp(-axis.timestep * axis.substeps / _RECOVERY_S)
            self._needed = min(target, self._left_after(self._backup()))
        return self._needed

    def backup(self) -> Array:
        """The control that is always admitted: brake both axes. From outside it leads back inside."""
        return self._point.control(np.zeros(self.plant.model.nu), self._backup())

    def _backup(self) -> _Control:
        """Braking; from outside the safe set, along the shortest way back to rest just inside it."""
        stop = self._among.brake(self._motion)
        if self._inside:
            return stop
        around = self._among.stop(self._among.step(self._motion, *stop))
        wall = nearest(around, self._among.walls, math.inf)[1]
        if wall is None:  # the state is not a number
            return stop
        across, along = gaps(around, wall)
        if across >= along:
            return self._stopped_at(0, wall, around[1] - wall[0] <= wall[1] - around[0]), stop[1]
        return stop[0], self._stopped_at(1, wall, around[3] - wall[2] <= wall[3] - around[2])

    def _stopped_at(self, axis: int, wall: Rectangle, before: bool, gap: float | None = None) -> float:
        """The control along an axis, within its bounds, whose rest point is this far before or behind a wall."""
        gap = self._room + _HAIR_M if gap is None else gap
        constants = self._among.y_axis if axis else self._among.x_axis
        x, v = self._motion[axis], self._motion[2 + axis]
        target = wall[2 * axis] - gap if before else wall[2 * axis + 1] + gap
        return max(constants.low, min(constants.control_to_rest_at(x, v, target), constants.high))

    def candidates(self, control: Array) -> list[Array]:
        """Admissible controls near a refused one, the nearest first: those that slide along the walls in its way."""
        (i, j), x_axis, y_axis = self._point.actuators, self._among.x_axis, self._among.y_axis
        x, y = float(control[i]), float(control[j])
        asked = max(x_axis.low, min(x, x_axis.high)), max(y_axis.low, min(y, y_axis.high))
        found = [c for c in self._turned(asked, _TURNS) if self._admitted(c)] if self._inside else []
        if not found:  # where the path fits and no rectangle does
            found = [self._approached(self._backup(), asked, axes) for axes in ((0, 1), (1, 0))]
        elif self.spec.velocity_clip is not None:
            found = [self._towards(c, asked) for c in found]
        found.sort(key=lambda c: math.dist(c, asked))
        return [self._point.control(control, c) for c in found]

    def _turned(self, control: _Control, turns: int) -> list[_Control]:
        """Controls whose rectangle is clear, by limiting one axis or the other at each wall in the way."""
        around = self._among.reached(self._motion, *control)
        wall = nearest(around, self._among.walls, self._room + 0.5 * _HAIR_M)[1]
        if wall is None:
            return [control]
        ways = self._aside(control, gaps(around, wall), wall) if turns else []
        return [found for way in ways for found in self._turned(way, turns - 1)]

    def _aside(self, control: _Control, gap: tuple[float, float], wall: Rectangle) -> list[_Control]:
        """The controls nearest to this one that stay clear of a wall: less along x, and less along y."""
        room, ways = self._room + _HAIR_M, []
        for axis in (0, 1):
            before, behind = self._motion[axis] < wall[2 * axis], self._motion[axis] > wall[2 * axis + 1]
            if not (before or behind):
                continue
            # At a corner the gap along the other axis counts too: the distance is Euclidean.
            other = max(gap[1 - axis], 0.0)
            limit = self._stopped_at(axis, wall, before, math.sqrt(max(room**2 - other**2, 0.0)))
            if (limit < control[axis]) if before else (limit > control[axis]):
                ways.append(_replaced(control, axis, limit))
        return ways

    def _approached(self, admitted: _Control, asked: _Control, axes: tuple[int, int]) -> _Control:
        """An admitted control, moved towards the one asked for along one axis and then along the other."""
        for axis in axes:
            admitted = self._towards(admitted, _replaced(admitted, axis, asked[axis]))
        return admitted

    def _towards(self, admitted: _Control, asked: _Control) -> _Control:
        """An admitted control, moved straight towards the one asked for as far as prediction allows."""

        def at(share: float) -> _Control:
            x, y = admitted
            return x + share * (asked[0] - x), y + share * (asked[1] - y)

        if not self._admitted(at(0.5**_HALVINGS), _HAIR_M):
            return admitted  # mostly: a wall straight ahead, and the rectangle was exact
        if self._admitted(asked, _HAIR_M):
            return asked
        low, high = 0.5**_HALVINGS, 1.0
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self._admitted(at(middle), _HAIR_M) else (low, middle)
        return at(low)

    def rows(self) -> HalfSpaces:
        """Bounds on the control along x and y: a convex part of what is admitted, braking included."""
        normals, offsets = [], []
        backup, room = self._backup(), self._room + _HAIR_M
        around = self._among.reached(self._motion, *backup)
        for wall in self._among.reachable(self._motion, room):
            gap = gaps(around, wall)
            corner = 0.0 < gap[0] < room and 0.0 < gap[1] < room
            # At a corner both axes keep their share of the distance; else the one with more room keeps it all.
            share = min(1.0, room / math.hypot(*gap)) if corner else 0.0
            for axis in (0, 1) if corner else (int(gap[1] > gap[0]),):
                before = wall[2 * axis] - around[2 * axis + 1] >= around[2 * axis] - wall[2 * axis + 1]
                sign = 1.0 if before else -1.0
                limit = self._stopped_at(axis, wall, before, share * gap[axis] if corner else room)
                normal = _replaced((0.0, 0.0), axis, sign)
                normals.append(self._point.control(np.zeros(self.plant.model.nu), normal))
                offsets.append(max(sign * limit, sign * backup[axis]))
        if not normals:
            return HalfSpaces.none(self.plant.model.nu)
        return HalfSpaces(np.array(normals), np.array(offsets))


def _replaced(control: _Control, axis: int, value: float) -> _Control:
    return (value, control[1]) if axis == 0 else (control[0], value)
