"""Clearance: keep points of the machine away from obstacles, with room to brake."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from safe_wrappers.checks import check_fields, name_list, non_negative, positive
from safe_wrappers.constraints.obstacles import Nearest, obstacles_from
from safe_wrappers.control.backup.stopping import sampled_acceleration_limit, sampled_inset
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.constraint import Array, BoundConstraint, Constraint, HalfSpaces, Memory
from safe_wrappers.plants.plant import Plant
from safe_wrappers.plants.queries.points import Points

# Around one point: the surfaces, clearances, approach speeds, relative velocities, its drift and its control matrix.
_Seen = tuple[Nearest, Array, Array, Array, Array, Array]


@dataclass
class Clearance(Constraint):
    """Keep `distance - (stopping distance) >= 0` from every point to every obstacle, also between samples.

    Best effort: head on, and in one dimension, the bound is exact for the declared `braking`. Elsewhere `margin` must
    cover that the direction to the obstacle and the drift change within a hold; and several obstacles, or joint
    limits, can ask for more than the actuators have.

    Args:
        obstacles: `Disc`, `Sphere`, `Box`, `Plane`, `Discs`.
        braking: Lower bound on the deceleration that the actuators can give in any direction and state, m/s^2.
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

    measures_approach: ClassVar[bool] = True

    def __post_init__(self) -> None:
        self.obstacles = obstacles_from(self.obstacles)
        self.braking = positive("braking", self.braking, "m/s^2")
        check_fields(self, non_negative, ("radius", "margin", "state_error"), "m")
        for name in ("bodies", "sites", "geoms"):
            setattr(self, name, name_list(name, getattr(self, name), least=0))
        self.position, self.velocity = list(self.position), list(self.velocity)
        if len(self.position) != len(self.velocity) or len(self.position) > 3:
            wanted = "position and velocity are up to three state indices each, in the same order"
            raise ConfigurationError(f"{wanted}; got {self.position} and {self.velocity}")

    def bind(self, plant: Plant) -> "BoundClearance":
        return BoundClearance(self, plant)


class BoundClearance(BoundConstraint):
    """Clearance on a plant."""

    spec: Clearance

    def __init__(self, spec: Clearance, plant: Plant) -> None:
        plant.require_acceleration("Clearance")
        super().__init__(spec, plant)
        named = {"body": spec.bodies, "site": spec.sites, "geom": spec.geoms}
        self._points = Points(plant, named, spec.position, spec.velocity)

    def observe(self, memory: Memory) -> None:
        self._observed: list[_Seen] | None = None

    def _gaps(self, p: Array, v: Array) -> tuple[Nearest, Array, Array, Array]:
        """Surfaces around a point: clearance, approach speed and relative velocity of each."""
        found = [o.nearest(p, self.plant) for o in self.spec.obstacles]
        near = Nearest(*(np.concatenate(part) for part in zip(*found, strict=True)))
        relative = v - near.velocity
        # The point is predicted over the delay; what comes to meet it is too (a lower bound: distance is convex).
        met = self.plant.delay_s * np.einsum("ij,ij->i", near.normal, near.velocity)
        clearance = near.distance - met - self.spec.radius
        return near, clearance, -np.einsum("ij,ij->i", near.normal, relative), relative

    def _seen(self) -> list[_Seen]:
        """What every point sees, once per observation."""
        if self._observed is None:
            every = self._points.accelerations()
            self._observed = [(*self._gaps(p, v), drift, effect) for p, v, drift, effect in every]
        return self._observed

    def value(self) -> Array:
        """Room left after braking, margin and state error not taken off, m, one per point and surface."""
        braking, hold = self.spec.braking, self.plant.control_dt
        seen = self._seen()
        return np.concatenate([sampled_inset(clear, speed, braking, hold) for _, clear, speed, *_ in seen])

    def approach(self) -> tuple[Array, Array]:
        """Clearances (m) and approach speeds (m/s, towards the obstacle), as measured, one per point and surface."""
        # Not through `_seen`: the accelerations, which only the rows need, are most of its work.
        gaps = [self._gaps(p, v) for p, v in self._points.motions()]
        return np.concatenate([g[1] for g in gaps]), np.concatenate([g[2] for g in gaps])

    def rows(self) -> HalfSpaces:
        """One row per point and surface whose limit the actuators could exceed."""
        normals, offsets = [], []
        braking, hold = self.spec.braking, self.plant.control_dt
        strongest = np.maximum(np.abs(self.plant.lower), np.abs(self.plant.upper))
        reserve = {"state_error": self.spec.state_error, "margin": self.spec.margin}
        for near, clearance, approach, relative, drift, effect in self._seen():
            limit = sampled_acceleration_limit(clearance, approach, braking, hold, **reserve)
            # approach acceleration = -n . (drift + effect u) - |sideways speed|^2 * curvature
            bend = np.einsum("ij,ij->i", near.curvature, relative**2)
            bend = bend - near.curvature.max(axis=1) * approach**2
            bend = np.where(clearance + self.spec.radius > 0.0, np.maximum(bend, 0.0), 0.0)
            normal = -near.normal @ effect
            offset = limit + near.normal @ drift + bend
            # Negated, so that a row that is not a number is kept, and fails, instead of being left out.
            reachable = ~(np.abs(normal) @ np.where(np.isfinite(strongest), strongest, 1e12) <= offset)
            normals.append(normal[reachable])
            offsets.append(offset[reachable])
        return HalfSpaces(np.concatenate(normals), np.concatenate(offsets))
