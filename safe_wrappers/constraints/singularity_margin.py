"""SingularityMargin: the manipulability of a point of an arm stays above a threshold."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Final

import mujoco
import numpy as np

from safe_wrappers.constraints.joints import chain, driven_joints, refuse_uncovered, scalar_joints
from safe_wrappers.constraints.rollout import RolloutConstraint
from safe_wrappers.control import barriers as of_arm
from safe_wrappers.errors import Array, ConfigurationError, check_fields, name_list, positive
from safe_wrappers.plants.mujoco.forecast import MujocoTrajectory
from safe_wrappers.plants.mujoco.model import SCALAR_JOINTS, SLIDE
from safe_wrappers.plants.plant import Plant

_JACOBIANS: Final = {"site": mujoco.mj_jacSite, "body": mujoco.mj_jacBody, "geom": mujoco.mj_jacGeom}
_SAMPLES = 2000  # configurations that say which manipulability can be reached
_STILL = 1e-9  # columns with a smaller norm are zero, m or rad per rad


@dataclass
class SingularityMargin(RolloutConstraint):
    """Keep the manipulability `w = sqrt(det(J J'))` of a frame, for declared task directions, above a threshold.

    With `task_speed` and `rate_limit` the threshold is the smallest w above which none of 2,000 sampled
    configurations needs more than the limit at that speed. w itself bounds no joint rate.

    Best effort: an executed control that is not flagged keeps the threshold at every physics substep of its step, for
    a plant that is right. Gravity, contacts and coupling can be stronger than the actuators.

    Args:
        threshold: Smallest w, in m^k for k directions and hinges.
        site: Name of the site whose motion the task is about; or
        body: of a body, meaning its frame's origin; or
        geom: of a geom, meaning its centre.
        directions: Of translation, some of "xyz" in the world's axes.
        joints: Names of those that do the task. None: those that an actuator drives directly and that move the frame.
        task_speed: Speed that has to be possible in every direction, m/s.
        rate_limit: Largest rate of each joint at that speed, rad/s for hinges, m/s for slides.
        margin: Kept free above the threshold, as a share of it.
        horizon: Control steps to forecast; cover the braking time.
        max_decrease: The most that w can fall within `horizon` steps, in shares of the threshold. None: unknown.

    Attributes:
        validated: The threshold that the sample gave; None if it was given, or before the constraint is bound.
    """

    threshold: float | None = None
    site: str | None = None
    body: str | None = None
    geom: str | None = None
    directions: str = "xyz"
    joints: Sequence[str] | None = None
    task_speed: float | None = None
    rate_limit: float | None = None
    margin: float = 0.0
    horizon: int = 5
    max_decrease: float | None = None

    validated: float | None = field(default=None, init=False, repr=False, compare=False)
    unit: ClassVar[str] = "shares of the threshold"

    def __post_init__(self) -> None:
        self._check_shared()
        check_fields(self, positive, ("threshold", "task_speed", "rate_limit"), "the task's units")
        given = [one is not None for one in (self.threshold, self.task_speed, self.rate_limit)]
        if given not in ([True, False, False], [False, True, True]):
            raise ConfigurationError(
                "give a threshold on the manipulability, or a task_speed and a rate_limit to validate one for; got "
                f"threshold={self.threshold!r}, task_speed={self.task_speed!r}, rate_limit={self.rate_limit!r}"
            )
        named = [kind for kind in _JACOBIANS if getattr(self, kind) is not None]
        if len(named) != 1 or not isinstance(getattr(self, named[0]), str):
            found = ", ".join(f"{kind}={getattr(self, kind)!r}" for kind in _JACOBIANS)
            raise ConfigurationError(f"name the one site, body or geom that the task moves; got {found}")
        self._kind = named[0]
        if self.joints is not None:
            self.joints = name_list("joints", self.joints, also="None for every driven joint")
        axes = self.directions
        if not (isinstance(axes, str) and axes and set(axes) <= set("xyz") and len(set(axes)) == len(axes)):
            raise ConfigurationError(f'directions is some of "xyz", each once; got {axes!r}')
        self._rows = ["xyz".index(axis) for axis in axes]

    def setup(self, plant: Plant) -> None:
        super().setup(plant)
        model, kind = self.plant.model, self._kind
        name = getattr(self, kind)
        self._index, what = self.plant.named(kind, name), f"the {kind} {name!r}"
        body = self._index if kind == "body" else int(getattr(model, f"{kind}_bodyid")[self._index])
        self._carriers = [j for j in sorted(chain(model, body)) if model.jnt_type[j] in SCALAR_JOINTS]
        self._joints = self._doing(what)
        self._data = mujoco.MjData(model)
        sampled = self._sample()
        jacobians = self._jacobians(sampled)
        moving = np.linalg.norm(jacobians, axis=1).max(axis=0) > _STILL
        self._joints = [j for j, moves in zip(self._joints, moving, strict=True) if moves]
        jacobians = jacobians[..., moving]
        task = f"directions={self.directions!r}"
        if len(self._joints) < len(self._rows):
            there = ", ".join(model.joint(j).name for j in self._joints) or "none"
            raise ConfigurationError(
                f"{len(self._joints)} joints cannot move {what} in {len(self._rows)} directions at once ({task}); "
                f"the joints are {there}"
            )
        # With as many joints as directions w is the determinant but for its sign, which turns at a singular pose.
        self._signed, self._side = len(self._joints) == len(self._rows), 1.0
        found = of_arm.manipulability(jacobians)
        most = float(found.max())
        if most < _STILL:
            nowhere = "cannot be moved in all of these directions at once in any configuration"
            raise ConfigurationError(f"{what} {nowhere}: {task}")
        if self.threshold is not None:
            self._threshold = self.threshold
        else:
            assert self.task_speed is not None and self.rate_limit is not None
            self.validated = of_arm.validated_threshold(jacobians, self.task_speed, self.rate_limit)
            self._threshold = self.validated
        if self._threshold * (1.0 + self.margin) >= most:
            raise ConfigurationError(
                f"no configuration has a manipulability above {self._threshold:g} with a margin of "
                f"{self.margin:g} of it: the largest of {_SAMPLES} in the joints' ranges is {most:.4g}, half of "
                f"them are above {float(np.median(found)):.4g}"
            )

    def _doing(self, what: str) -> list[int]:
        """The joints that do the task, in the order of their ids; an error where they do not move the frame."""
        model = self.plant.model
        there = ", ".join(model.joint(j).name for j in self._carriers)
        if self.joints is None:
            found = [j for j in driven_joints(model) if j in self._carriers]
            if not found:
                wanted = f"no actuator drives a joint that moves {what}: name the joints that move it"
                raise ConfigurationError(f"{wanted}; there are {there or 'none'}")
            remedy = "Name those that do the task: joints=[...]"
            refuse_uncovered(model, self._carriers, remedy, self.plant.has_acceleration)
            return found
        ids = scalar_joints(self.plant, self.joints)
        for j, name in zip(ids, self.joints, strict=True):
            if j not in self._carriers:
                wanted = f"the joint {name!r} does not move {what}"
                raise ConfigurationError(f"{wanted}; those that do: {there}")
        return sorted(set(ids))

    def _sample(self) -> Array:
        """Configurations with the joints that carry the frame uniform in their ranges, shape (samples, nq).

        A hinge without a range turns once; a slide without one, and every other joint, stays at the model's zero.
        """
        model, rng = self.plant.model, np.random.default_rng(0)
        addresses = model.jnt_qposadr[self._carriers]
        turn = np.where(model.jnt_type[self._carriers] == SLIDE, 0.0, np.pi)[:, None] * [-1.0, 1.0]
        free = model.qpos0[addresses][:, None] + turn
        limited = model.jnt_limited[self._carriers].astype(bool)[:, None]
        ranges = np.where(limited, model.jnt_range[self._carriers], free)
        qpos = np.tile(model.qpos0, (_SAMPLES, 1))
        qpos[:, addresses] = rng.uniform(ranges[:, 0], ranges[:, 1], (_SAMPLES, len(addresses)))
        return qpos

    def _jacobians(self, qpos: Array) -> Array:
        """The task's rows over the joints that do it, at finite positions (k, nq): shape (k, m, n)."""
        model, data, of_frame = self.plant.model, self._data, _JACOBIANS[self._kind]
        found = np.empty((len(qpos), 3, model.nv))
        for q, linear in zip(qpos, found, strict=True):
            data.qpos[:] = q
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            of_frame(model, data, linear, None, self._index)
        return found[:, self._rows][..., model.jnt_dofadr[self._joints]]

    def _measure(self, qpos: Array) -> Array:
        """w, shape (k,), below zero beyond the singular pose; NaN where a position is not finite."""
        finite, w = np.isfinite(qpos).all(axis=1), np.full(len(qpos), np.nan)
        if finite.any():
            jacobians = self._jacobians(qpos[finite])
            signed = (
                self._side * np.linalg.det(jacobians) if self._signed else of_arm.manipulability(jacobians)
            )
            w[finite] = signed
        return w

    def h_along(self, path: MujocoTrajectory) -> Array:
        """What w has above the threshold, in shares of it."""
        if path.control is None:
            if self.plant.model.nmocap:
                pose = self.plant.pose()
                self._data.mocap_pos[:], self._data.mocap_quat[:] = pose.mocap_pos, pose.mocap_quat
            self._side = 1.0
            self._side = -1.0 if self._measure(path.qpos)[0] < 0.0 else 1.0
        return np.asarray(self._measure(path.qpos) / self._threshold - 1.0)[:, None]
