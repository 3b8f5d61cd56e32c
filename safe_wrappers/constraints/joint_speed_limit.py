"""JointSpeedLimit: a bound on hinge and slide speeds, held at every physics substep."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.constraints.constraint import HalfSpaces, Promise, non_negative, positive
from safe_wrappers.constraints.cut import cut
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants.mujoco import MujocoPlant
from safe_wrappers.plants.plant import Plant

Array = NDArray[np.float64]

_ROUNDING = 1e-9
"""rad/s or m/s: less is round-off."""
_RECOVERY_S = 0.1
"""Time constant, s, in which a joint above its limit has to come back to it."""

_HINGE_OR_SLIDE = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
_DRIVES = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))


@dataclass
class JointSpeedLimit:
    """Keep `|joint speed| <= limit`.

    Speed under a force has relative degree one, so no stopping inset is needed: the rows bound the speed at
    the end of the held control step, and a rollout of that step on the plant's model checks every physics
    substep, contacts and joint limits included.

    What it promises: an executed control that is not flagged infeasible or fallback keeps the limit at every
    substep of its step, exactly, for a plant that is right. That there always is such a control cannot be
    promised: gravity, coupling, contacts or joint stops can be stronger than the actuators. Hence best effort;
    then the step is counted infeasible and the fallback runs.

    Args:
        limit: In rad/s for hinges, m/s for slides; one number, or one per named joint.
        joints: Joint names. None takes every hinge and slide that an actuator drives directly.
        margin: Kept free below the limit, for model and state error, in the same units.
    """

    limit: float | Sequence[float]
    joints: Sequence[str] | None = None
    margin: float = 0.0

    promise: Promise = field(default="best effort", init=False)

    def __post_init__(self) -> None:
        self.margin = non_negative("margin", self.margin, "rad/s or m/s")
        many = isinstance(self.limit, Sequence | np.ndarray)
        limits = list(self.limit) if isinstance(self.limit, Sequence | np.ndarray) else [self.limit]
        checked = [positive("limit", one, "rad/s or m/s") for one in limits]
        if self.joints is not None:
            if isinstance(self.joints, str):
                raise ConfigurationError(f"joints is a list of names, got the string {self.joints!r}")
            self.joints = list(self.joints)
            if not self.joints:
                raise ConfigurationError("joints is a list of names, or None for every driven joint; got []")
        if not checked:
            raise ConfigurationError("limit is one number, or a list with one per joint; got []")
        self.limit = checked if many else checked[0]
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
        """Roll the held step out: every substep stays below the bound, or comes back to it."""
        return bool((self._slacks(plant, control) >= -_ROUNDING).all())

    def cut(self, plant: MujocoPlant, control: Array) -> HalfSpaces:
        """The predicted speeds, linearised about a refused control."""
        return cut(lambda u: self._slacks(plant, u), control, plant.lower, plant.upper)

    def _slacks(self, plant: MujocoPlant, control: Array) -> Array:
        """What is left below the bound along the held step and at its end, per joint, shape (2 k,)."""
        now = np.abs(plant.qvel[self._dofs])
        speeds = np.abs([data.qvel[self._dofs] for data in plant.rollout(control)])
        over = np.maximum(now - self._bound, 0.0)
        # From above the bound: never faster on the way, and closer at the end.
        on_the_way = self._bound + over
        at_the_end = self._bound + over * np.exp(-plant.hold_s / _RECOVERY_S)
        return np.concatenate([on_the_way - speeds.max(axis=0), at_the_end - speeds[-1]])

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
