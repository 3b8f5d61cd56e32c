"""SpeedLimit and Workspace: how fast points of the machine may be, and where."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from safe_wrappers.constraints.obstacles import distances, obstacles_from
from safe_wrappers.constraints.rollout import RolloutConstraint
from safe_wrappers.errors import (
    Array,
    ConfigurationError,
    UnknownNameError,
    check_fields,
    finite_array,
    name_list,
    non_negative,
    positive,
    true_or_false,
)
from safe_wrappers.filter.constraint import Memory
from safe_wrappers.plants.mujoco.forecast import MujocoTrajectory
from safe_wrappers.plants.plant import Plant

DIRECTIONS = ("+x", "-x", "x", "+y", "-y", "y", "+z", "-z", "z", "xy", "xyz")


@dataclass
class SpeedLimit(RolloutConstraint):
    """Keep the speed of a body, or of the centre of mass, below a limit.

    Speed is displacement over time, as Gymnasium's `x_velocity` is. Over a control step two displacements count: from
    state to state, and that of MuJoCo's `data.xpos`, from which Gymnasium reads Ant's and Humanoid's speed.

    Best effort: the control step of an executed control that is not flagged keeps the limit, for a plant that is
    right. Such a control need not exist: in flight no actuator changes the momentum, and contact forces have one
    sign.

    Args:
        limit: m/s.
        body: Name of the body whose frame origin counts; None: the whole machine's centre of mass.
        direction: "+x" and so on limit one sign, "x" both, "xy" and "xyz" the length of the vector.
        average: "step" over a control step, "substep" over a physics substep.
        margin: Kept free below the limit, m/s.
        horizon: Control steps to forecast; the actuated joints brake after the first.
        max_decrease: The most that the speed can rise within `horizon` control steps, m/s; states with more than that
            left need no forecast.
        look_ahead_below: m/s; where the present speed leaves at least this much, a control that leaves it too after
            its own control step, margin taken off, is admitted without a look at the others. None: always look.
        euler_look_ahead: Look at the others by Euler steps where the model's own are Runge-Kutta's, at a quarter of
            the price. The first control step is always simulated by the model's own.
    """

    limit: float
    body: str | None = None
    direction: str = "xy"
    average: Literal["step", "substep"] = "step"
    margin: float = 0.0
    horizon: int = 3
    max_decrease: float | None = None
    look_ahead_below: float | None = None
    euler_look_ahead: bool = False

    unit: ClassVar[str] = "m/s"
    recovery_s: ClassVar[float] = 0.0  # the next step's displacement starts afresh

    def __post_init__(self) -> None:
        self._check_shared()
        check_fields(self, positive, ("limit", "look_ahead_below"), "m/s")
        self.euler_look_ahead = true_or_false("euler_look_ahead", self.euler_look_ahead)
        if self.margin >= self.limit:
            raise ConfigurationError(f"the margin {self.margin} leaves nothing of the limit {self.limit}")
        if self.direction not in DIRECTIONS:
            raise UnknownNameError(f"no direction {self.direction!r}; choose {', '.join(DIRECTIONS)}")
        if self.average not in ("step", "substep"):
            raise UnknownNameError(f"no average {self.average!r}; choose step or substep")

    def setup(self, plant: Plant) -> None:
        super().setup(plant)
        self._body = None if self.body is None else self.plant.named("body", self.body)
        letters = self.direction.strip("+-")
        self._axes = slice("xyz".index(letters[0]), "xyz".index(letters[-1]) + 1)
        self._sign = {"+": 1.0, "-": -1.0}.get(self.direction[0])
        self._window = self.plant.substeps if self.average == "step" else 1
        self.scale = self.limit

    def observe(self, memory: Memory) -> None:
        if self._body is None:
            mass = self.plant.model.body_mass
            self._shares = mass / mass.sum()
        pose = self.plant.pose()
        data = self.plant.published() if self.average == "step" else None
        self._published = None if data is None else self._point(data.xpos, data.xipos).copy()
        self._before, self._here = memory.get("here"), self._point(pose.xpos, pose.xipos).copy()
        memory["here"] = self._here

    def _point(self, frames: Array, centres: Array) -> Array:
        if self._body is None:
            return np.asarray((self._shares @ centres)[..., self._axes])
        return np.asarray(frames[..., self._body, self._axes])

    def _left(self, displacements: Array, substeps: int) -> Array:
        """What is left below the limit, shape (...,), of displacements over so many substeps, shape (..., axes)."""
        velocity = displacements / (substeps * self.plant.control_dt / self.plant.substeps)
        if self._sign is not None:
            return np.asarray(self.limit - self._sign * velocity[..., 0])
        return np.asarray(self.limit - np.sqrt((velocity * velocity).sum(axis=-1)))

    def h_along(self, path: MujocoTrajectory) -> Array:
        """What is left below the limit, of both displacements where the published one counts, m/s."""
        if path.control is None:
            return self._now()
        poses = path.poses(self._window)
        points = self._point(poses.frames, poses.centres)
        way = np.empty((len(points) + 1, 1 if self._published is None else 2, points.shape[1]))
        way[0, 0], way[1:, 0] = self._here, points
        if self._published is not None:
            way[0, 1] = self._published
            way[1:, 1] = self._point(path.published_frames, path.published_centres)
        return self._left(way[1:] - way[:-1], self._window)

    def _now(self) -> Array:
        if self._before is None or self.average == "substep":
            # What the last substep shows; at a reset nothing else has moved yet that could be measured.
            earlier = self.plant.substep_ago()
            moved = self._here - self._point(earlier.frames[0], earlier.centres[0])
            return self._left(moved[None, None], 1)
        return self._left((self._here - self._before)[None, None], self.plant.substeps)


@dataclass
class Workspace(RolloutConstraint):
    """Keep points of the machine inside an axis-aligned box and outside obstacles, in world coordinates.

    Moving obstacles are taken where they are.

    Best effort: an executed control that is not flagged keeps the workspace at every physics substep of its step, for
    a plant that is right. Near a singular pose, under loads stronger than the actuators, or where the body pitches
    after the joints have stopped, a point can move on after the forecast.

    Args:
        low: Smallest x, y, z, m; None is no bound, for all or for one: `[None, -0.5, None]`.
        high: Largest, likewise.
        keep_out: `Disc`, `Sphere`, `Box`, `Plane`, `Discs`.
        bodies: Names of bodies; their frame origins are the points.
        sites: Names of sites, likewise.
        geoms: Names of geoms: their centres.
        radius: Of the machine around each point, m.
        margin: Kept free, m.
        horizon: Control steps to forecast; cover the braking time.
        max_decrease: The farthest that a point can move within `horizon` control steps, m. None: unknown.
    """

    low: Sequence[float | None] | None = None
    high: Sequence[float | None] | None = None
    keep_out: Sequence[Any] = ()
    bodies: Sequence[str] = ()
    sites: Sequence[str] = ()
    geoms: Sequence[str] = ()
    radius: float = 0.0
    margin: float = 0.0
    horizon: int = 5
    max_decrease: float | None = None

    unit: ClassVar[str] = "m"
    at_rest: ClassVar[float] = 1e-4

    def __post_init__(self) -> None:
        self._check_shared()
        self.radius = non_negative("radius", self.radius, "m")
        self.low, self.high = _corner("low", self.low), _corner("high", self.high)
        self.keep_out = obstacles_from(self.keep_out, "keep_out", optional=True)
        for name in ("bodies", "sites", "geoms"):
            setattr(self, name, name_list(name, getattr(self, name), least=0))
        self._low = np.array([-np.inf if v is None else v for v in self.low or [None] * 3])
        self._high = np.array([np.inf if v is None else v for v in self.high or [None] * 3])
        if not (np.isfinite([self._low, self._high]).any() or self.keep_out):
            raise ConfigurationError("give a bound in low or high (m), or something to keep_out of")
        if (self._high - self._low <= 2.0 * (self.margin + self.radius)).any():
            raise ConfigurationError(
                f"nothing is left of the box from {self.low} to {self.high} m with a radius of {self.radius} m "
                f"and a margin of {self.margin} m on each side"
            )

    def setup(self, plant: Plant) -> None:
        super().setup(plant)
        if not (self.bodies or self.sites or self.geoms):
            there = ", ".join(self.plant.names("body"))
            wanted = "name the bodies, sites or geoms to keep inside"
            raise ConfigurationError(f"{wanted}; the bodies are {there}")
        m = self.plant.model
        named = {"body": self.bodies, "site": self.sites, "geom": self.geoms}
        bodies, sites, geoms = ([self.plant.named(kind, n) for n in names] for kind, names in named.items())
        self._bodies = np.array([*bodies, *m.site_bodyid[sites], *m.geom_bodyid[geoms]], dtype=int)
        self._offsets = np.vstack([np.zeros((len(bodies), 3)), m.site_pos[sites], m.geom_pos[geoms]])

    def points(self, path: MujocoTrajectory) -> Array:
        """World positions, shape (instants, points, 3), m."""
        poses = path.poses()
        rotated = np.einsum("kpij,pj->kpi", poses.axes[:, self._bodies], self._offsets)
        return np.asarray(poses.frames[:, self._bodies] + rotated)

    def h_along(self, path: MujocoTrajectory) -> Array:
        """Room of every point to every bound and surface, m."""
        points = self.points(path)
        k = len(points)
        low, high = np.isfinite(self._low), np.isfinite(self._high)
        above, below = (points - self._low)[:, :, low], (self._high - points)[:, :, high]
        left = [above.reshape(k, -1), below.reshape(k, -1)]
        every = points.reshape(-1, 3)
        for obstacle in self.keep_out:
            surfaces = distances(obstacle, every, self.plant)
            left.append(surfaces.reshape(k, points.shape[1] * surfaces.shape[1]))
        return np.concatenate(left, axis=1) - self.radius


def _corner(name: str, given: Sequence[float | None] | None) -> list[float | None] | None:
    if given is None:
        return None
    corner = [None if v is None else float(finite_array(name, v)) for v in given]
    if len(corner) != 3:
        raise ConfigurationError(f"{name} is [x, y, z] in m, None where there is no bound; got {given!r}")
    return corner
