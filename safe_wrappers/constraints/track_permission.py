"""TrackPermission: stop while the permission of a track has expired."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from safe_wrappers.checks import name_list, positive
from safe_wrappers.errors import UnknownNameError
from safe_wrappers.filter.constraint import BoundConstraint, Constraint, HalfSpaces
from safe_wrappers.plants.mujoco.plant import MujocoPlant, require_mujoco
from safe_wrappers.plants.plant import Plant


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

    def bind(self, plant: Plant) -> "BoundTrackPermission":
        return BoundTrackPermission(self, plant)


class BoundTrackPermission(BoundConstraint):
    """TrackPermission on a plant."""

    spec: TrackPermission
    plant: MujocoPlant

    def __init__(self, spec: TrackPermission, plant: Plant) -> None:
        machine = require_mujoco(plant, "TrackPermission needs a MujocoPlant: it brakes a body of its model")
        machine.require_acceleration("TrackPermission")
        super().__init__(spec, machine)
        self.plant.named("body", self.spec.body)
        names = list(self.plant.attribute("track_names"))
        chosen = names if self.spec.tracks is None else list(self.spec.tracks)
        for name in chosen:
            if name not in names:
                raise UnknownNameError(f"there is no track {name!r}; there are {', '.join(names)}")
        self._which = [names.index(name) for name in chosen]

    def rows(self) -> HalfSpaces:
        """Two rows per axis that a control acts on, while a permission has expired; else none."""
        if bool(np.asarray(self.plant.attribute("permitted"))[self._which].all()):
            return HalfSpaces.none(self.plant.lower.size)
        _, v, drift, effect = self.plant.point("body", self.spec.body)
        acted = np.abs(effect).max(axis=1) > 1e-12
        v, drift, effect = v[acted], drift[acted], effect[acted]
        speed = float(np.sqrt(v @ v))
        left = max(0.0, 1.0 - self.spec.braking * self.plant.control_dt / speed) if speed > 0.0 else 0.0
        allowed = np.abs(left * v)  # in each axis, at the end of the hold
        least, most = ((end - v) / self.plant.control_dt - drift for end in (-allowed, allowed))
        return HalfSpaces(np.concatenate([effect, -effect]), np.concatenate([most, -least]))
