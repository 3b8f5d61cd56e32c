"""Workspace: named points stay inside a box, and out of what stands in it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from safe_wrappers.checks import Array, finite_array, name_list, non_negative
from safe_wrappers.constraints.obstacles import distances, obstacle_marks, obstacles_from
from safe_wrappers.constraints.rollout import BoundRollout, RolloutConstraint
from safe_wrappers.drawing.marks import Mark, ball, edges, pad
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.mujoco.forecast import Forecast
from safe_wrappers.plants.plant import Plant

_STILL_M = 1e-4  # what is at rest on springy contacts moves by less within a forecast


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

    def bind(self, plant: Plant) -> "BoundWorkspace":
        return BoundWorkspace(self, plant)


class BoundWorkspace(BoundRollout):
    """Workspace on a plant."""

    spec: Workspace

    def __init__(self, spec: Workspace, plant: Plant) -> None:
        super().__init__(spec, plant)
        if not (self.spec.bodies or self.spec.sites or self.spec.geoms):
            there = ", ".join(self.plant.names("body"))
            wanted = "name the bodies, sites or geoms to keep inside"
            raise ConfigurationError(f"{wanted}; the bodies are {there}")
        m = self.plant.model
        named = {"body": self.spec.bodies, "site": self.spec.sites, "geom": self.spec.geoms}
        bodies, sites, geoms = ([self.plant.named(kind, n) for n in names] for kind, names in named.items())
        self._bodies = np.array([*bodies, *m.site_bodyid[sites], *m.geom_bodyid[geoms]], dtype=int)
        self._offsets = np.vstack([np.zeros((len(bodies), 3)), m.site_pos[sites], m.geom_pos[geoms]])

    def _points(self, frames: Array, axes: Array) -> Array:
        """World positions, shape (k, points, 3)."""
        rotated = np.einsum("kpij,pj->kpi", axes[:, self._bodies], self._offsets)
        return np.asarray(frames[:, self._bodies] + rotated)

    def _left(self, points: Array) -> Array:
        """Room of every point to every bound and surface, shape (k, n)."""
        k = len(points)
        low, high = np.isfinite(self.spec._low), np.isfinite(self.spec._high)
        above, below = (points - self.spec._low)[:, :, low], (self.spec._high - points)[:, :, high]
        left = [above.reshape(k, -1), below.reshape(k, -1)]
        every = points.reshape(-1, 3)
        for obstacle in self.spec.keep_out:
            surfaces = distances(obstacle, every, self.plant)
            left.append(surfaces.reshape(k, points.shape[1] * surfaces.shape[1]))
        return np.concatenate(left, axis=1) - self.spec.radius

    def now(self) -> Array:
        pose = self.plant.pose()
        points = self._points(pose.xpos[None], pose.xmat.reshape(1, -1, 3, 3))
        return np.asarray(self._left(points)[0])

    def room(self, forecast: Forecast) -> Array:
        poses = forecast.poses()
        return self._left(self._points(poses.frames, poses.axes))

    def keeps_limit(self, control: Array) -> bool:
        if not 0.0 <= self._least < self.spec.margin:
            return False
        left = self.room(self.plant.forecast(control, self.spec.horizon)).min(axis=0)
        kept = self._outside + self.spec.margin - _STILL_M
        return bool((left >= np.maximum(kept, 0.0)).all())

    def draw(self) -> list[Mark]:
        """The points; the edges of the box in which they stay, or what is near of its planes; the obstacles."""
        spec, pose = self.spec, self.plant.pose()
        inset = spec.margin + spec.radius
        points = self._points(pose.xpos[None], pose.xmat.reshape(1, -1, 3, 3))[0]
        found = [ball("way", p, max(spec.radius, 0.012)) for p in points]
        low, high = spec._low + inset, spec._high - inset
        if np.isfinite([low, high]).all():
            found += edges("limit", low, high, 0.004)
        else:
            for end in (low, high):
                for axis in np.flatnonzero(np.isfinite(end)):
                    foot = points[0].copy()
                    foot[axis] = end[axis]
                    found.append(pad("keep out", foot, np.eye(3)[axis], 0.2))
        for p in points:
            found += obstacle_marks(spec.keep_out, self.plant, inset, p)
        return found


def _corner(name: str, given: Sequence[float | None] | None) -> list[float | None] | None:
    if given is None:
        return None
    corner = [None if v is None else float(finite_array(name, v)) for v in given]
    if len(corner) != 3:
        raise ConfigurationError(f"{name} is [x, y, z] in m, None where there is no bound; got {given!r}")
    return corner
