"""Clearance: keep points of the machine away from obstacles; TrackPermission: rest while a track is not sure."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from safe_wrappers.constraints.obstacles import obstacles_from
from safe_wrappers.control.backup.stopping import Machine, Nearest, approach_rows, approaches
from safe_wrappers.errors import (
    Array,
    ConfigurationError,
    UnknownNameError,
    check_fields,
    name_list,
    non_negative,
    positive,
)
from safe_wrappers.filter.constraint import Constraint, HalfSpaces, Memory
from safe_wrappers.plants.mujoco.plant import MujocoPlant, require_mujoco
from safe_wrappers.plants.plant import Plant


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

    predicts: ClassVar[bool] = False
    rows_decide: ClassVar[bool] = True

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

    def setup(self, plant: Plant) -> None:
        plant.require_acceleration("Clearance")
        super().setup(plant)
        named = {"body": self.bodies, "site": self.sites, "geom": self.geoms}
        self._named = [(kind, name) for kind, names in named.items() for name in names]
        if isinstance(plant, MujocoPlant):
            if not self._named:
                there = ", ".join(plant.names("body"))
                wanted = "name the bodies, sites or geoms to keep clear"
                raise ConfigurationError(f"{wanted}; the model has the bodies {there}")
            for kind, name in self._named:
                plant.named(kind, name)
        elif not self.position:
            given = "position=[0, 1], velocity=[2, 3]"
            raise ConfigurationError(f"on an AnalyticPlant say where the point is in the state: {given}")

    def observe(self, memory: Memory) -> None:
        self._observed: tuple[Array, HalfSpaces] | None = None

    def _motions(self) -> list[tuple[Array, Array]]:
        """Position, m, and velocity, m/s, of each point."""
        if isinstance(self.plant, MujocoPlant):
            return [self.plant.motion(kind, name) for kind, name in self._named]
        x = self.plant.state
        return [(x[self.position], x[self.velocity])]

    def _accelerations(self) -> list[tuple[Array, Array, Array, Array]]:
        """Position, velocity, drift and control matrix of the acceleration of each point, SI."""
        if isinstance(self.plant, MujocoPlant):
            return [self.plant.point(kind, name) for kind, name in self._named]
        x, p, v = self.plant.state, self.position, self.velocity
        return [(x[p], x[v], self.plant.f[v], self.plant.g[v])]

    def _surfaces(self, p: Array) -> Nearest:
        """The surfaces around a point."""
        found = [o.nearest(p, self.plant) for o in self.obstacles]
        return Nearest(*(np.concatenate(part) for part in zip(*found, strict=True)))

    def _look(self) -> tuple[Array, HalfSpaces]:
        """The rooms and the rows, once per observation."""
        if self._observed is None:
            plant = self.plant
            limits = plant.lower, plant.upper, plant.delay_s, plant.control_dt
            machine = Machine(*limits, self.radius, self.braking, self.state_error + self.margin)
            found = [
                approach_rows(self._surfaces(p), v, drift, effect, machine)
                for p, v, drift, effect in self._accelerations()
            ]
            rooms, normals, offsets = map(np.concatenate, zip(*found, strict=True))
            self._observed = rooms, HalfSpaces(normals, offsets)
        return self._observed

    def h_along(self, path: Any) -> Array:
        """Of the present state: room left after braking, margin and state error not taken off, m, per surface."""
        return self._look()[0][None]

    def approach(self) -> tuple[Array, Array]:
        """Clearances (m) and approach speeds (m/s, towards the obstacle), as measured, one per point and surface."""
        # Not through `_look`: the accelerations, which only the rows need, are most of its work.
        late = self.plant.delay_s, self.radius
        found = [approaches(self._surfaces(p), v, *late) for p, v in self._motions()]
        clearances, speeds = zip(*found, strict=True)
        return np.concatenate(clearances), np.concatenate(speeds)

    def points(self, path: Any) -> Array:
        """Where they are now, shape (1, points, d), m."""
        return np.array([[p for p, _ in self._motions()]])

    def rows(self) -> HalfSpaces:
        """One row per point and surface whose limit the actuators could exceed."""
        return self._look()[1]


@dataclass
class TrackPermission(Constraint):
    """While the permission of a track has expired, brake to rest, at least as hard as `braking`.

    An `OcclusionPenalty` inside the filter says which tracks may be relied on.

    Best effort: executed controls brake as declared, or the step is flagged infeasible; the drift changes within a
    held step. Where standing still is not safe, add `EscapeClearance` with `TrackedDiscs`.

    Args:
        body: Name of the body whose frame origin is stopped.
        braking: Deceleration that the actuators can give in every direction, m/s^2.
        tracks: Names of the tracks that count (`track_names` of the OcclusionPenalty); None: all.

    Source: appendix "Continuous Lyapunov and Riccati covariance dynamics".
    """

    body: str
    braking: float
    tracks: Sequence[str] | None = None

    def __post_init__(self) -> None:
        self.braking = positive("braking", self.braking, "m/s^2")
        if self.tracks is not None:
            self.tracks = name_list("tracks", self.tracks, also="None for all")

    def setup(self, plant: Plant) -> None:
        machine = require_mujoco(plant, "TrackPermission needs a MujocoPlant: it brakes a body of its model")
        machine.require_acceleration("TrackPermission")
        super().setup(machine)
        self.plant.named("body", self.body)
        names = list(self.plant.attribute("track_names"))
        chosen = names if self.tracks is None else list(self.tracks)
        for name in chosen:
            if name not in names:
                raise UnknownNameError(f"there is no track {name!r}; there are {', '.join(names)}")
        self._which = [names.index(name) for name in chosen]

    def rows(self) -> HalfSpaces | None:
        """Two rows per axis that a control acts on, while a permission has expired; else none."""
        if bool(np.asarray(self.plant.attribute("permitted"))[self._which].all()):
            return None
        _, v, drift, effect = self.plant.point("body", self.body)
        acted = np.abs(effect).max(axis=1) > 1e-12
        v, drift, effect = v[acted], drift[acted], effect[acted]
        speed = float(np.sqrt(v @ v))
        left = max(0.0, 1.0 - self.braking * self.plant.control_dt / speed) if speed > 0.0 else 0.0
        allowed = np.abs(left * v)  # in each axis, at the end of the hold
        least, most = ((end - v) / self.plant.control_dt - drift for end in (-allowed, allowed))
        return HalfSpaces(np.concatenate([effect, -effect]), np.concatenate([most, -least]))
