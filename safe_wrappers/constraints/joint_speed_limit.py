"""JointSpeedLimit: a bound on hinge and slide speeds, held at every physics substep."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.constraints.constraint import HalfSpaces, Promise, non_negative, positive
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants.mujoco import MujocoPlant
from safe_wrappers.plants.plant import Plant

Array = NDArray[np.float64]

_HINGE_OR_SLIDE = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
_DRIVES = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))


@dataclass
class JointSpeedLimit:
    """Keep `|joint speed| <= limit`.

    Speed under a force has relative degree one, so no stopping inset is needed: the row bounds the speed at
    the end of the held control step, and a rollout of that step on the plant's model checks every physics
    substep. Proved for a plant that is right and joints whose actuators can overcome gravity and coupling at
    the limit; where they cannot, the step is infeasible, counted, and the least violation is applied.

    Args:
        limit: In rad/s for hinges, m/s for slides; one number, or one per named joint.
        joints: Joint names. None takes every hinge and slide that an actuator drives directly.
        margin: Kept free below the limit, for model and state error, in the same units.
    """

    limit: float | Sequence[float]
    joints: Sequence[str] | None = None
    margin: float = 0.0

    promise: Promise = "proved"

    def __post_init__(self) -> None:
        self.margin = non_negative("margin", self.margin, "rad/s or m/s")
        limits = list(self.limit) if isinstance(self.limit, Sequence) else [self.limit]
        checked = [positive("limit", one, "rad/s or m/s") for one in limits]
        if self.joints is not None:
            if isinstance(self.joints, str):
                raise ConfigurationError(f"joints is a list of names, got the string {self.joints!r}")
            self.joints = list(self.joints)
            if not self.joints:
                raise ConfigurationError("joints is a list of names, or None for every driven joint; got []")
        if not checked:
            raise ConfigurationError("limit is one number, or a list with one per joint; got []")
        self.limit = checked if isinstance(self.limit, Sequence) else checked[0]
        if min(checked) <= self.margin:
            raise ConfigurationError(f"the margin {self.margin} leaves nothing of the limit {self.limit}")

    def bind(self, plant: Plant) -> None:
        """Resolve the joints."""
        if not isinstance(plant, MujocoPlant):
            raise UnsupportedEnvError(
                "JointSpeedLimit needs a MujocoPlant (named joints); on an AnalyticPlant write "
                "Barrier(lambda x: limit**2 - x[i]**2)"
            )
        model = plant.model
        if self.joints is None:
            driven = {
                int(model.actuator_trnid[a, 0])
                for a in range(model.nu)
                if model.actuator_trntype[a] in _DRIVES
            }
            ids = [j for j in sorted(driven) if model.jnt_type[j] in _HINGE_OR_SLIDE]
            if not ids:
                raise ConfigurationError(
                    "no actuator drives a hinge or slide directly: name the joints; the model has: "
                    + ", ".join(plant.names("joint"))
                )
        else:
            ids = [plant.named("joint", name) for name in self.joints]
            for j, name in zip(ids, self.joints, strict=True):
                if model.jnt_type[j] not in _HINGE_OR_SLIDE:
                    raise ConfigurationError(f"joint {name!r} is neither a hinge nor a slide")
        self._dofs = np.array([int(model.jnt_dofadr[j]) for j in ids])
        try:
            limits = np.broadcast_to(np.asarray(self.limit, dtype=np.float64), (len(ids),))
        except ValueError:
            raise ConfigurationError(f"expected one limit or {len(ids)}, got {self.limit}") from None
        self._bound = limits - self.margin
        self._limits = limits

    def value(self, plant: MujocoPlant) -> Array:
        """Speed left below the limit, per joint, rad/s or m/s."""
        return np.asarray(self._limits - np.abs(plant.qvel[self._dofs]))

    def admits(self, plant: MujocoPlant, control: Array) -> bool:
        """Roll the held step out; every substep must stay below the bound.

        From outside the set the step must bring the speed down by what a substep's round-off cannot hide.
        """
        bound = np.maximum(self._bound, np.abs(plant.qvel[self._dofs]) - 1e-9)
        return all(bool((np.abs(data.qvel[self._dofs]) <= bound).all()) for data in plant.rollout(control))

    def rows(self, plant: MujocoPlant) -> HalfSpaces:
        """Two rows per joint that could reach its limit within the hold."""
        drift, effect = plant.acceleration
        v = plant.qvel[self._dofs]
        a0, a = drift[self._dofs], effect[self._dofs]
        reach = np.abs(v) + plant.hold_s * (
            np.abs(a0) + np.abs(a) @ np.maximum(np.abs(plant.lower), np.abs(plant.upper))
        )
        near = reach > self._bound
        normals = np.vstack([a[near], -a[near]])
        room = self._bound[near] / plant.hold_s
        rate, bias = v[near] / plant.hold_s, a0[near]
        return HalfSpaces(normals, np.concatenate([room - rate - bias, room + rate + bias]))
