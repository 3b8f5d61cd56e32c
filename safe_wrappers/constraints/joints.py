"""Limits on the positions and the speeds of hinges and slides, and which joints a constraint means."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from safe_wrappers.constraints.rollout import RolloutConstraint
from safe_wrappers.errors import Array, ConfigurationError, float_array, name_list, positive
from safe_wrappers.filter.constraint import HalfSpaces
from safe_wrappers.plants.mujoco.forecast import MujocoTrajectory
from safe_wrappers.plants.mujoco.model import AT_A_JOINT, FREE, SCALAR_JOINTS
from safe_wrappers.plants.mujoco.plant import MujocoPlant
from safe_wrappers.plants.plant import Plant


def driven_joints(model: mujoco.MjModel) -> list[int]:
    """The hinges and slides that an actuator drives directly."""
    return [j for j in _direct(model) if model.jnt_type[j] in SCALAR_JOINTS]


def per_joint(name: str, given: float | Sequence[float], count: int) -> Array:
    """One value for all joints, or one for each, as an array of shape (count,)."""
    try:
        return np.broadcast_to(np.asarray(given, dtype=np.float64), (count,))
    except ValueError:
        raise ConfigurationError(f"expected one {name} or {count}, got {given}") from None


def _direct(model: mujoco.MjModel) -> list[int]:
    kinds = model.actuator_trntype
    return sorted({int(model.actuator_trnid[a, 0]) for a in range(model.nu) if kinds[a] in AT_A_JOINT})


def chain(model: mujoco.MjModel, body: int) -> list[int]:
    """The joints between a body and the world."""
    found: list[int] = []
    while body:
        first = int(model.body_jntadr[body])
        found += range(first, first + int(model.body_jntnum[body]))
        body = int(model.body_parentid[body])
    return found


def refuse_uncovered(model: mujoco.MjModel, joints: Iterable[int], remedy: str, forces: bool = True) -> None:
    """Refuse to take the driven joints for all where an action moves others of these joints (ids) as well.

    It does where actions are displacements, not `forces`, pull at a tendon or a site, or drive a ball joint, and it
    may where the model has equalities, or tendons that hold. What only swings, slides or flexes along is not meant.
    The message says which joints would be covered, which not, and the `remedy`.
    """
    covered = driven_joints(model)
    only_joints = bool(np.isin(model.actuator_trntype, AT_A_JOINT).all()) and _direct(model) == covered
    rest = [j for j in joints if j not in covered]
    tied = model.eq_active0.any() or (model.tendon_limited != 0).any() or (model.tendon_stiffness > 0.0).any()
    if rest and not (forces and only_joints and not tied):
        named = [", ".join(model.joint(j).name or f"#{j}" for j in ids) for ids in (covered, rest)]
        raise ConfigurationError(
            "an action of this machine may move more joints than those that an actuator drives directly. Covered "
            f"would be: {named[0]}. Not covered: {named[1]}. {remedy}"
        )


def stops(model: mujoco.MjModel) -> tuple[list[int], Array, Array]:
    """The driven hinges and slides that have a range, and its ends, rad or m.

    Refused where an action moves other joints that have one as well.
    """
    every = np.flatnonzero(model.jnt_limited).tolist()
    refuse_uncovered(model, every, "joint_tolerance=None leaves all joints alone")
    limited = [j for j in driven_joints(model) if j in every]
    low, high = model.jnt_range[limited].T
    return limited, low, high


def scalar_joints(plant: MujocoPlant, names: Sequence[str] | None) -> list[int]:
    """Ids of the named hinges and slides, or of all that an actuator drives directly; an error if none is."""
    model = plant.model
    if names is None:
        ids = driven_joints(model)
        if not ids:
            there = ", ".join(plant.names("joint"))
            wanted = "no actuator drives a hinge or slide directly: name the joints"
            raise ConfigurationError(f"{wanted}; the model has: {there}")
        # What flies freely is no joint of a machine.
        own = [j for j in range(model.njnt) if model.jnt_type[j] != FREE]
        every = [model.joint(j).name for j in own if model.jnt_type[j] in SCALAR_JOINTS]
        refuse_uncovered(model, own, f"Name those that you mean: joints={every}", plant.has_acceleration)
        return ids
    ids = [plant.named("joint", name) for name in names]
    for j, name in zip(ids, names, strict=True):
        if model.jnt_type[j] not in SCALAR_JOINTS:
            raise ConfigurationError(f"joint {name!r} is neither a hinge nor a slide")
    return ids


@dataclass
class JointPositionLimit(RolloutConstraint):
    """Keep joint positions in a range that may be narrower than the model's own.

    Best effort: an executed control that is not flagged keeps the range at every physics substep of its step, for a
    plant that is right. Gravity, coupling, contacts and passive joints can be stronger than the actuators.

    Args:
        lower: Smallest position, rad for hinges, m for slides; one, or one per joint. None: the model's own range.
        upper: Largest, likewise.
        joints: Names. None: all that an actuator drives directly; refused where an action moves others as well.
        margin: Kept free inside the range, rad or m.
        horizon: Control steps to forecast; cover the braking time.
        max_decrease: The farthest that a joint can move within `horizon` control steps, rad or m. None: unknown.
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

    def setup(self, plant: Plant) -> None:
        super().setup(plant)
        ids = scalar_joints(self.plant, self.joints)
        model: mujoco.MjModel = self.plant.model
        self._qpos = model.jnt_qposadr[ids]
        limited = model.jnt_limited[ids].astype(bool)
        own = np.where(limited[:, None], model.jnt_range[ids], [-np.inf, np.inf])
        low = own[:, 0] if self.lower is None else per_joint("lower", self.lower, len(ids))
        high = own[:, 1] if self.upper is None else per_joint("upper", self.upper, len(ids))
        narrow = ~(high - low > 2.0 * self.margin)
        if narrow.any():
            j = int(np.flatnonzero(narrow)[0])
            raise ConfigurationError(
                f"nothing is left of the range of joint {model.joint(ids[j]).name!r}: {low[j]:g} to {high[j]:g} "
                f"with a margin of {self.margin:g} at both ends"
            )
        self._below, self._above = np.isfinite(low), np.isfinite(high)
        self._low, self._high = low[self._below], high[self._above]
        if not (self._low.size or self._high.size):
            named = ", ".join(repr(model.joint(j).name) for j in ids)
            raise ConfigurationError(
                f"none of these joints has a range in the model: pass lower and upper ({named})"
            )

    def h_along(self, path: MujocoTrajectory) -> Array:
        """Room to every bound that there is, the lower ones first, rad or m."""
        q = path.qpos[:, self._qpos]
        return np.concatenate([q[:, self._below] - self._low, self._high - q[:, self._above]], axis=1)


def _positions(name: str, given: float | Sequence[float] | None) -> float | list[float] | None:
    if given is None:
        return None
    found = float_array(name, given)
    if found.ndim > 1 or not found.size or np.isnan(found).any():
        raise ConfigurationError(f"{name} is a position in rad or m, or one per joint; got {given!r}")
    listed: float | list[float] = found.tolist()
    return listed


@dataclass
class JointSpeedLimit(RolloutConstraint):
    """Keep `|joint speed| <= limit`.

    Best effort: an executed control that is not flagged keeps the limit at every physics substep of its step, for a
    plant that is right. Gravity, coupling, contacts and joint stops can be stronger than the actuators.

    Args:
        limit: In rad/s for hinges, m/s for slides; one number, or one per named joint.
        joints: Names. None: all that an actuator drives directly; refused where an action moves others as well.
        margin: Kept free below the limit, rad/s or m/s.
        horizon: Control steps to forecast; the actuated joints brake after the first.
        max_decrease: The most that a speed can rise within `horizon` control steps, rad/s or m/s. None: unknown.
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

    def setup(self, plant: Plant) -> None:
        super().setup(plant)
        ids = scalar_joints(self.plant, self.joints)
        self._dofs = self.plant.model.jnt_dofadr[ids]
        self._limits = per_joint("limit", self.limit, len(ids))
        self.scale = float(np.min(self.limit))

    def h_along(self, path: MujocoTrajectory) -> Array:
        """Speed left below the limit, per joint, rad/s or m/s."""
        return np.asarray(self._limits - np.abs(path.qvel[:, self._dofs]))

    def rows(self) -> HalfSpaces | None:
        """Two rows per joint that could reach its limit within the hold; none where controls are no forces."""
        if not self.plant.has_acceleration:
            return None
        plant, hold, bound = self.plant, self.plant.control_dt, self._limits - self.margin
        drift, effect = (of_dof[self._dofs] for of_dof in plant.acceleration)
        speed, strongest = plant.qvel[self._dofs], np.maximum(np.abs(plant.lower), np.abs(plant.upper))
        # No push, not NaN, where an actuator without effect is infinitely strong.
        pushes = (np.abs(effect) * np.where(effect != 0.0, strongest, 0.0)).sum(axis=1)
        near = np.abs(speed) + hold * (np.abs(drift) + pushes) > bound
        drift, effect, room, rate = drift[near], effect[near], bound[near] / hold, speed[near] / hold
        normals = np.concatenate([effect, -effect])
        return HalfSpaces(normals, np.concatenate([room - rate - drift, room + rate + drift]))
