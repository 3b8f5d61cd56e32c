"""JointSpeedLimit: a bound on hinge and slide speeds, held at every physics substep."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from safe_wrappers.checks import name_list, positive
from safe_wrappers.constraints.limits.joints import per_joint, scalar_joints
from safe_wrappers.constraints.rollout import RECOVERY_S, RENAMED, BoundRollout, RolloutConstraint
from safe_wrappers.deprecation import deprecated_parameters
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.constraint import Array, HalfSpaces
from safe_wrappers.plants.mujoco.forecast import Forecast
from safe_wrappers.plants.mujoco.plant import require_mujoco
from safe_wrappers.plants.plant import Plant


@deprecated_parameters(renamed=RENAMED)
@dataclass
class JointSpeedLimit(RolloutConstraint):
    """Keep `|joint speed| <= limit`.

    Rows bound the speed at the end of the held control step; a forecast of that step checks every physics substep.

    Best effort: an executed control that is not flagged keeps the limit at every physics substep of its step, for a
    plant that is right. Gravity, coupling, contacts and joint stops can be stronger than the actuators.

    Args:
        limit: In rad/s for hinges, m/s for slides; one number, or one per named joint.
        joints: Names. None: every hinge and slide that an actuator drives directly; refused where an action moves
            others as well.
        margin: Kept free below the limit, rad/s or m/s.
        horizon: Control steps to forecast; the actuated joints brake after the first.
        max_decrease: The most that a joint's speed can rise within `horizon` control steps, rad/s or m/s; states with
            more than that left need no forecast.
    """

    limit: float | Sequence[float]
    joints: Sequence[str] | None = None
    margin: float = 0.0
    horizon: int = 1
    max_decrease: float | None = None

    unit: ClassVar[str] = "rad/s or m/s"

    def __post_init__(self) -> None:
        self._check_shared()
        limits = self.limit if isinstance(self.limit, Sequence | np.ndarray) else [self.limit]
        checked = [positive("limit", one, "rad/s or m/s") for one in limits]
        if self.joints is not None:
            self.joints = name_list("joints", self.joints, also="None for every driven joint")
        if not checked:
            raise ConfigurationError("limit is one number, or a list with one per joint; got []")
        self.limit = checked if limits is self.limit else checked[0]
        if min(checked) <= self.margin:
            raise ConfigurationError(f"the margin {self.margin} leaves nothing of the limit {self.limit}")

    def bind(self, plant: Plant) -> "BoundJointSpeedLimit":
        return BoundJointSpeedLimit(self, plant)


class BoundJointSpeedLimit(BoundRollout):
    """JointSpeedLimit on a plant."""

    spec: JointSpeedLimit

    @property
    def scale(self) -> float:
        return float(np.min(self.spec.limit))

    def __init__(self, spec: JointSpeedLimit, plant: Plant) -> None:
        hint = "on an AnalyticPlant write Barrier(lambda x: limit**2 - x[i]**2)"
        require_mujoco(plant, f"JointSpeedLimit needs a MujocoPlant (named joints); {hint}")
        super().__init__(spec, plant)
        ids = scalar_joints(self.plant, self.spec.joints)
        self._dofs = np.array([int(self.plant.model.jnt_dofadr[j]) for j in ids])
        self._limits = per_joint("limit", self.spec.limit, len(ids))
        self._bound = self._limits - self.spec.margin

    def now(self) -> Array:
        """Speed left below the limit, per joint, rad/s or m/s."""
        self._speeds = np.abs(self.plant.qvel[self._dofs])
        return np.asarray(self._limits - self._speeds)

    def room(self, forecast: Forecast) -> Array:
        return np.asarray(self._limits - np.abs(forecast.qvel[:, self._dofs]))

    def slacks(self, control: Array) -> Array:
        """What is left below the bound along the forecast and at its end, per joint, shape (2 k,)."""
        left = self.room(self.plant.forecast(control, self.spec.horizon)) - self.spec.margin
        over = np.maximum(self._speeds - self._bound, 0.0)
        # From above the bound, joint by joint: never faster on the way, and closer at the end.
        decay = np.exp(-self.spec.horizon * self.plant.control_dt / RECOVERY_S)
        return np.concatenate([left.min(axis=0) + over, left[-1] + over * decay])

    def rows(self) -> HalfSpaces:
        """Two rows per joint that could reach its limit within the hold; none where controls are no forces."""
        if not self.plant.has_acceleration:
            return super().rows()
        v, (a0, a) = self.plant.qvel[self._dofs], (part[self._dofs] for part in self.plant.acceleration)
        strongest = np.maximum(np.abs(self.plant.lower), np.abs(self.plant.upper))
        # No push, not NaN, where an actuator without effect is infinitely strong.
        pushes = np.abs(a) * np.where(a == 0.0, 0.0, strongest)
        highest = np.abs(v) + self.plant.control_dt * (np.abs(a0) + pushes.sum(axis=1))
        near = highest > self._bound
        normals = np.vstack([a[near], -a[near]])
        room = self._bound[near] / self.plant.control_dt
        rate, bias = v[near] / self.plant.control_dt, a0[near]
        return HalfSpaces(normals, np.concatenate([room - rate - bias, room + rate + bias]))
