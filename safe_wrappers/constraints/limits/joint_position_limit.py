"""JointPositionLimit: hinges and slides stay inside a range, with room to brake."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from safe_wrappers.checks import name_list
from safe_wrappers.constraints.limits.joints import per_joint, scalar_joints
from safe_wrappers.constraints.rollout import RENAMED, BoundRollout, RolloutConstraint
from safe_wrappers.deprecation import deprecated_parameters
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.constraint import Array
from safe_wrappers.plants.mujoco.forecast import Forecast
from safe_wrappers.plants.plant import Plant


@deprecated_parameters(renamed=RENAMED)
@dataclass
class JointPositionLimit(RolloutConstraint):
    """Keep joint positions in a range that may be narrower than the model's own.

    A forecast of the held control, and then of every actuated joint braking, has to keep the range at every substep.

    Best effort: an executed control that is not flagged keeps the range at every physics substep of its step, for a
    plant that is right. Gravity, coupling, contacts and passive joints can be stronger than the actuators.

    Args:
        lower: Smallest position, rad for hinges, m for slides; one, or one per joint. None: the model's own range.
        upper: Largest, likewise.
        joints: Names. None: every hinge and slide that an actuator drives directly; refused where an action moves
            others as well.
        margin: Kept free inside the range, rad or m.
        horizon: Control steps to forecast; cover the braking time.
        max_decrease: The farthest that a joint can move within `horizon` control steps, rad or m; states with more
            than that left need no forecast.
    """

    lower: float | Sequence[float] | None = None
    upper: float | Sequence[float] | None = None
    joints: Sequence[str] | None = None
    margin: float = 0.0
    horizon: int = 5
    max_decrease: float | None = None

    unit: ClassVar[str] = "rad or m"

    def __post_init__(self) -> None:
        self._check_shared()
        for name in ("lower", "upper"):
            setattr(self, name, _positions(name, getattr(self, name)))
        if self.joints is not None:
            self.joints = name_list("joints", self.joints, also="None for every driven joint")

    def bind(self, plant: Plant) -> "BoundJointPositionLimit":
        return BoundJointPositionLimit(self, plant)


class BoundJointPositionLimit(BoundRollout):
    """JointPositionLimit on a plant."""

    spec: JointPositionLimit

    def __init__(self, spec: JointPositionLimit, plant: Plant) -> None:
        super().__init__(spec, plant)
        ids = scalar_joints(self.plant, self.spec.joints)
        model: mujoco.MjModel = self.plant.model
        self._qpos = np.array([int(model.jnt_qposadr[j]) for j in ids])
        limited = model.jnt_limited[ids].astype(bool)
        own = np.where(limited[:, None], model.jnt_range[ids], [-np.inf, np.inf])
        lower, upper = self.spec.lower, self.spec.upper
        self._low = own[:, 0] if lower is None else per_joint("lower", lower, len(ids))
        self._high = own[:, 1] if upper is None else per_joint("upper", upper, len(ids))
        narrow = ~(self._high - self._low > 2.0 * self.spec.margin)
        if narrow.any():
            j = int(np.flatnonzero(narrow)[0])
            raise ConfigurationError(
                f"nothing is left of the range of joint {model.joint(ids[j]).name!r}: {self._low[j]:g} to "
                f"{self._high[j]:g} with a margin of {self.spec.margin:g} at both ends"
            )
        self._below, self._above = np.isfinite(self._low), np.isfinite(self._high)
        if not (self._below.any() or self._above.any()):
            raise ConfigurationError("none of these joints has a range in the model: pass lower and upper")

    def now(self) -> Array:
        return self._left(self.plant.qpos)

    def _left(self, qpos: Array) -> Array:
        """Room to every bound that there is, the lower ones first, shape (..., n)."""
        q = qpos[..., self._qpos]
        return np.concatenate(
            [(q - self._low)[..., self._below], (self._high - q)[..., self._above]], axis=-1
        )

    def room(self, forecast: Forecast) -> Array:
        return self._left(forecast.qpos)


def _positions(name: str, given: float | Sequence[float] | None) -> float | list[float] | None:
    if given is None:
        return None
    try:
        found = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        found = np.array(np.nan)
    if found.ndim > 1 or not found.size or np.isnan(found).any():
        raise ConfigurationError(f"{name} is a position in rad or m, or one per joint; got {given!r}")
    listed: float | list[float] = found.tolist()
    return listed
