"""Clearance: keep points of the machine away from obstacles, with room to brake."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.constraints.obstacles.obstacle_kinds import obstacles_from
from safe_wrappers.constraints.obstacles.obstacles import Nearest
from safe_wrappers.control.backup.stopping import sampled_acceleration_limit, sampled_inset
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.constraint import HalfSpaces, Promise, non_negative, positive
from safe_wrappers.plants.mujoco.plant import MujocoPlant
from safe_wrappers.plants.plant import Plant

Array = NDArray[np.float64]


class _Seen(NamedTuple):
    """The surfaces around one point, and how its acceleration depends on the control."""

    near: Nearest
    clearance: Array
    approach: Array
    relative: Array
    drift: Array
    effect: Array


@dataclass
class Clearance:
    """Keep `distance - (stopping distance) >= 0` from every point to every obstacle, also between samples.

    The row bounds the acceleration towards the obstacle that may be held for a control interval, so that full
    braking afterwards still stops in front of it (`control/backup/stopping.py`). Delay is the plant's: the state is
    predicted over it.

    What it promises: in one dimension, and head on, the bound is exact for the declared `braking`. Elsewhere
    the direction to the obstacle turns within a hold and the drift changes, which `margin` must cover; and
    several obstacles at once, or joint limits, can ask for more than the actuators have. Hence best effort:
    infeasible steps are counted and the fallback runs. A machine that cannot brake in every direction (a
    heading drive) needs `HeadingDriveClearance`.

    Args:
        obstacles: `Disc`, `Sphere`, `Box`, `Plane`, `Discs`.
        braking: Validated lower bound on the deceleration that the actuators can give in any direction
            and every state of the envelope, m/s^2.
        bodies: Names of bodies whose frame origins are kept clear (MujocoPlant).
        sites: Names of sites, likewise.
        geoms: Names of geoms: their centres, likewise.
        position: Indices of the point's coordinates in the state (AnalyticPlant).
        velocity: Indices of its velocity in the state, in the same order.
        radius: Of the machine around the point, m.
        margin: Fixed protective distance, m.
        state_error: Bound on the error of the measured distance, m.

    Source: appendix "Relative degree and kinetic stopping insets".
    """

    obstacles: Sequence[Any]
    braking: float
    bodies: Sequence[str] = ()
    sites: Sequence[str] = ()
    geoms: Sequence[str] = ()
    position: Sequence[int] = ()
    velocity: Sequence[int] = ()
    radius: float = 0.0
    margin: float = 0.0
    state_error: float = 0.0

    promise: Promise = field(default="best effort", init=False)
    needs_acceleration: ClassVar[bool] = True

    def __post_init__(self) -> None:
        self.obstacles = obstacles_from(self.obstacles)
        self.braking = positive("braking", self.braking, "m/s^2")
        for name in ("radius", "margin", "state_error"):
            setattr(self, name, non_negative(name, getattr(self, name), "m"))
        for name in ("bodies", "sites", "geoms"):
            if isinstance(getattr(self, name), str):
                raise ConfigurationError(f"{name} is a list of names, got the string {getattr(self, name)!r}")
            setattr(self, name, list(getattr(self, name)))
        self.position, self.velocity = list(self.position), list(self.velocity)
        if len(self.position) != len(self.velocity) or len(self.position) > 3:
            raise ConfigurationError(
                "position and velocity are up to three state indices each, in the same order; got "
                f"{self.position} and {self.velocity}"
            )

    def bind(self, plant: Plant) -> None:
        """Resolve the points on the plant."""
        self._stamp: int | None = None
        if isinstance(plant, MujocoPlant):
            if not (self.bodies or self.sites or self.geoms):
                raise ConfigurationError(
                    "name the bodies, sites or geoms to keep clear; the model has the bodies "
                    + ", ".join(plant.names("body"))
                )
            for name in self.bodies:
                plant.named("body", name)
            for name in self.sites:
                plant.named("site", name)
            for name in self.geoms:
                plant.named("geom", name)
        elif not self.position:
            raise ConfigurationError(
                "on an AnalyticPlant say where the point is in the state: position=[0, 1], velocity=[2, 3]"
            )

    def _motions(self, plant: Plant) -> list[tuple[Array, Array]]:
        """Position and velocity of each point."""
        if isinstance(plant, MujocoPlant):
            named = {"body": self.bodies, "site": self.sites, "geom": self.geoms}
            return [plant.motion(kind, name) for kind, names in named.items() for name in names]
        return [(plant.state[self.position], plant.state[self.velocity])]

    def _points(self, plant: Plant) -> list[tuple[Array, Array, Array, Array]]:
        """Position, velocity, acceleration drift and control matrix of each point."""
        if isinstance(plant, MujocoPlant):
            named = {"body": self.bodies, "site": self.sites, "geom": self.geoms}
            return [plant.point(kind, name) for kind, names in named.items() for name in names]
        x = plant.state
        p, v = self.position, self.velocity
        return [(x[p], x[v], plant.f[v], plant.g[v])]

    def _gaps(self, plant: Plant, p: Array, v: Array) -> tuple[Nearest, Array, Array, Array]:
        """Surfaces around a point: clearance, approach speed and relative velocity of each."""
        found = [o.nearest(p, plant) for o in self.obstacles]
        near = Nearest(*(np.concatenate(part) for part in zip(*found, strict=True)))
        relative = v - near.velocity
        # The point is predicted over the delay; what comes to meet it is too (a lower bound: distance is convex).
        met = plant.delay_s * np.einsum("ij,ij->i", near.normal, near.velocity)
        clearance = near.distance - met - self.radius
        return near, clearance, -np.einsum("ij,ij->i", near.normal, relative), relative

    def _look(self, plant: Plant) -> list[_Seen]:
        """What every point sees, once per observation."""
        stamp = getattr(plant, "stamp", None)
        if stamp is None or stamp != self._stamp:
            self._stamp = stamp
            self._seen = [
                _Seen(*self._gaps(plant, p, v), drift, effect) for p, v, drift, effect in self._points(plant)
            ]
        return self._seen

    def value(self, plant: Plant) -> Array:
        """Room left after braking, margin and state error not taken off, m, one per point and surface."""
        return np.concatenate(
            [sampled_inset(s.clearance, s.approach, self.braking, plant.hold_s) for s in self._look(plant)]
        )

    def approach(self, plant: Plant) -> tuple[Array, Array]:
        """Clearances (m) and approach speeds (m/s, towards the obstacle), one per point and surface.

        As measured: neither margin, nor state error, nor the way of braking is taken off.
        """
        # Not through `_look`: the accelerations, which only the rows need, are most of its work.
        gaps = [self._gaps(plant, p, v) for p, v in self._motions(plant)]
        return np.concatenate([g[1] for g in gaps]), np.concatenate([g[2] for g in gaps])

    def rows(self, plant: Plant) -> HalfSpaces:
        """One row per point and surface whose limit the actuators could exceed."""
        normals, offsets = [], []
        strongest = np.maximum(np.abs(plant.lower), np.abs(plant.upper))
        reserve = {"state_error": self.state_error, "margin": self.margin}
        for near, clearance, approach, relative, drift, effect in self._look(plant):
            limit = sampled_acceleration_limit(clearance, approach, self.braking, plant.hold_s, **reserve)
            # approach acceleration = -n . (drift + effect u) - |sideways speed|^2 * curvature
            bend = (
                np.einsum("ij,ij->i", near.curvature, relative**2) - near.curvature.max(axis=1) * approach**2
            )
            bend = np.where(clearance + self.radius > 0.0, np.maximum(bend, 0.0), 0.0)
            normal = -near.normal @ effect
            offset = limit + near.normal @ drift + bend
            # Negated, so that a row that is not a number is kept, and fails, instead of being left out.
            reachable = ~(np.abs(normal) @ np.where(np.isfinite(strongest), strongest, 1e12) <= offset)
            normals.append(normal[reachable])
            offsets.append(offset[reachable])
        return HalfSpaces(np.concatenate(normals), np.concatenate(offsets))
