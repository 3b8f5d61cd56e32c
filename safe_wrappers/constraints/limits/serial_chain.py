"""The joints between the world and a named frame, and the frame's Jacobian over them at many configurations."""

from collections.abc import Sequence
from typing import Literal

import mujoco
import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.constraints.limits import joints as of_joints
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.mujoco.model import SCALAR_JOINTS, SLIDE
from safe_wrappers.plants.mujoco.plant import MujocoPlant

FrameKind = Literal["site", "body", "geom"]


class SerialChain:
    """Hinges and slides that carry a named frame, and what their speeds do to it.

    Attributes:
        joints: Ids of the n hinges and slides between the world and the frame, from the base on, shape (n,).
        qpos, dofs: Their addresses in qpos and in qvel, shapes (n,).
        scalar: No ball and no free joint carries the frame.

    Raises:
        UnknownNameError: No frame of that name.
        ConfigurationError: No hinge and no slide carries it.
    """

    def __init__(self, plant: MujocoPlant, kind: FrameKind, name: str) -> None:
        model = self._model = plant.model
        index = plant.named(kind, name)
        self._plant, self._what = plant, f"the {kind} {name!r}"
        body = index if kind == "body" else int(getattr(model, f"{kind}_bodyid")[index])
        carriers, self._body = list[int](), body
        while body:
            first = int(model.body_jntadr[body])
            carriers += range(first, first + int(model.body_jntnum[body])) if first >= 0 else []
            body = int(model.body_parentid[body])
        scalar = sorted(j for j in carriers if model.jnt_type[j] in SCALAR_JOINTS)
        self.joints = np.array(scalar, dtype=int)
        if not self.joints.size:
            wanted = f"no hinge or slide moves {self._what}: it has no manipulability"
            raise ConfigurationError(f"{wanted}; the model has the joints {', '.join(plant.names('joint'))}")
        self.qpos, self.dofs = model.jnt_qposadr[self.joints], model.jnt_dofadr[self.joints]
        self.scalar = len(self.joints) == len(carriers)
        self._slides = (model.jnt_type[self.joints] == SLIDE)[:, None]
        self._data = mujoco.MjData(model)
        # Names, not views of the data: a copy of this object would hold on to the old one's.
        kinds = {"site": "site_", "body": "", "geom": "geom_"}
        self._place, self._turn, self._index = f"{kinds[kind]}xpos", f"{kinds[kind]}xmat", index

    def columns(self, names: Sequence[str] | None) -> list[int]:
        """Places in `joints` of the named ones, which must carry the frame, or of those that are driven directly."""
        model = self._model
        there = ", ".join(str(model.joint(j).name) for j in self.joints)
        if names is None:
            driven = of_joints.driven_joints(model)
            found = [i for i, j in enumerate(self.joints) if int(j) in driven]
            if not found:
                wanted = f"no actuator drives a joint that moves {self._what}: name the joints that move it"
                raise ConfigurationError(f"{wanted}; there are {there}")
            remedy = "Name those that do the task: joints=[...]"
            of_joints.refuse_uncovered(model, self.joints.tolist(), remedy, self._plant.has_acceleration)
            return found
        places = {int(j): i for i, j in enumerate(self.joints)}
        ids = of_joints.scalar_joints(self._plant, names)
        for j, name in zip(ids, names, strict=True):
            if j not in places:
                wanted = f"the joint {name!r} does not move {self._what}"
                raise ConfigurationError(f"{wanted}; those that do: {there}")
        if len(set(ids)) < len(ids):
            raise ConfigurationError(f"a joint is named twice: {list(names)}")
        return sorted(places[j] for j in ids)

    def name(self, column: int) -> str:
        return str(self._model.joint(self.joints[column]).name)

    def place(self, data: mujoco.MjData) -> None:
        """Take over the poses of the bodies that the env moves by hand (mocap), for Jacobians from now on."""
        if self._model.nmocap:
            self._data.mocap_pos[:], self._data.mocap_quat[:] = data.mocap_pos, data.mocap_quat

    def jacobians(self, qpos: Array) -> tuple[Array, Array]:
        """At finite positions (k, nq): Jacobians (k, 6, n), and the frame's axes as columns (k, 3, 3).

        Rows: velocity of the frame's origin, then angular velocity, in the world's axes.
        """
        model, data, k = self._model, self._data, len(qpos)
        jacobians, turns = np.empty((k, 6, len(self.joints))), np.empty((k, 9))
        linear, angular = np.empty((2, 3, model.nv))
        origin, turn = getattr(data, self._place)[self._index], getattr(data, self._turn)[self._index]
        for i, q in enumerate(qpos):
            data.qpos[:] = q
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_jac(model, data, linear, angular, origin, self._body)
            jacobians[i, :3], jacobians[i, 3:] = linear[:, self.dofs], angular[:, self.dofs]
            turns[i] = turn
        return jacobians, turns.reshape(k, 3, 3)

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Configurations with these joints uniform in their ranges, shape (count, nq).

        A hinge without a range turns once; a slide without one, and every other joint, stays at the model's zero.
        """
        model = self._model
        zero = model.qpos0[self.qpos][:, None]
        free = np.where(self._slides, zero, zero + np.array([-np.pi, np.pi]))
        limited = model.jnt_limited[self.joints].astype(bool)[:, None]
        ranges = np.where(limited, model.jnt_range[self.joints], free)
        qpos = np.tile(model.qpos0, (count, 1))
        qpos[:, self.qpos] = rng.uniform(ranges[:, 0], ranges[:, 1], (count, len(self.joints)))
        return qpos
