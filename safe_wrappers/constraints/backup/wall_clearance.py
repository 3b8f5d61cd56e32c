"""WallClearance: for a point mass on two axes, out of the walls of a maze."""

import math
from dataclasses import dataclass
from itertools import product

import numpy as np

from safe_wrappers.control.backup.damped_axis import brake, clipped
from safe_wrappers.control.backup.point_among_walls import distances, slides, way
from safe_wrappers.errors import Array, check_fields, non_negative, positive
from safe_wrappers.filter.constraint import Constraint
from safe_wrappers.plants.mujoco.planar_point import nearest_first, planar_point, walls
from safe_wrappers.plants.mujoco.plant import require_mujoco
from safe_wrappers.plants.plant import Model, Plant, Trajectory

_NOISE_M = 1e-12  # of float64 between one way and the next


@dataclass
class WallClearance(Constraint, Model):
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
    rounding = 1e-7  # m; of braking as float32, once per control step

    def __post_init__(self) -> None:
        self.margin = non_negative("margin", self.margin, "m")
        check_fields(self, positive, ("velocity_clip",), "m/s")

    def setup(self, plant: Plant) -> None:
        hint = "on an AnalyticPlant use Clearance([Box(...)], position=[0, 1], velocity=[2, 3], braking=...)"
        super().setup(require_mujoco(plant, f"WallClearance needs a MujocoPlant; {hint}"))
        clip = self.velocity_clip
        self._point = point = planar_point(self.plant, math.inf if clip is None else clip)
        around, self._reach = walls(self.plant.model, point.body)
        self._walls = np.array(around).reshape(-1, 4)
        nowhere = np.zeros(2)  # compiled here, not in a step
        slides(point.axes, nowhere, nowhere, nowhere, np.ones((1, 4)), 0.0, clip is None)

    def rollout(self, control: Array | None, horizon: int = 1) -> Trajectory:
        """The way until rest, as positions at every physics step, shape (instants, 2)."""
        point = self._point
        held = np.zeros((0, 2)) if control is None else control[None, point.actuators]
        return Trajectory(control, way(point.axes, *point.motion(self.plant), held))

    def h_along(self, path: Trajectory) -> Array:
        """Distance from every wall, until a contact would be reported, m."""
        # For every clip above what one hold reverses, the way is inside the rectangle around this one.
        return distances(path.states, self._walls, self.velocity_clip is None) - self._reach

    def proposals(self, control: Array | None) -> list[Array]:
        """Of None: braking, and from outside what gets farther off the walls. Else controls that slide along them."""
        point = self._point
        place, velocity = point.motion(self.plant)
        now = float(self.h_along(self.rollout(None)).min(initial=np.inf))
        inside = now >= self.margin - self.rounding
        if control is None:
            axes = zip(point.axes, velocity, strict=True)
            ways = [(brake(a, clipped(a, v)), *(() if inside else (a.low, a.high))) for a, v in axes]
            controls = [point.control(np.zeros(self.plant.lower.size), pair) for pair in product(*ways)]
            return [max(controls, key=lambda u: self.h_along(self.rollout(u))[-1].min(initial=np.inf))]
        if not (inside and len(self._walls)):
            return []
        # More than the margin by what rounding may lose, if braking leaves that.
        asked, room = control[point.actuators], self._reach + min(self.margin + self.rounding, now - _NOISE_M)
        pairs = slides(point.axes, place, velocity, asked, self._walls, room, self.velocity_clip is None)
        return [point.control(control, pair) for pair in nearest_first(pairs, asked)]

    def points(self, path: Trajectory) -> Array:
        """The point on its way, m, shape (instants, 1, 2)."""
        return path.states[:, None]
