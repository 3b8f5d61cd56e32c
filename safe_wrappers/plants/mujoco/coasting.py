"""Simulates a machine on a free joint: a held control, then none until it rests."""

import math
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.errors import Array, ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants.mujoco.plant import MujocoPlant

# m/s, of the body and its farthest point: slower counts as at rest. Safety-Gymnasium's car then moves on by 0.8 mm.
_REST_SPEED = 0.01
# Numbers that a plant's model may have different from the env's, by kind of object.
_ADOPTED = (
    ("nbody", int(mujoco.mjtObj.mjOBJ_BODY), ("body_mass", "body_inertia", "body_ipos", "body_iquat")),
    ("ngeom", int(mujoco.mjtObj.mjOBJ_GEOM), ("geom_friction",)),
    ("nu", int(mujoco.mjtObj.mjOBJ_ACTUATOR), ("actuator_gainprm", "actuator_forcerange")),
)


class Course(NamedTuple):
    """Where the machine's body is at k instants, one per physics substep."""

    places: Array  # its origin from above, shape (k, 2), m
    ahead: Array  # its x axis from above, unit vectors, shape (k, 2)
    rests: bool  # whether it has come to rest by the last instant


class Coasting:
    """Runs the machine's model: a held control first, no control after it.

    Args:
        plant: Bound; a run starts at its state and uses its masses, damping, friction and motors.
        body: Name of the machine's body; it has a free joint.
        alone: A model of the machine without obstacles, which is faster to step, with joints and actuators of the
            same names. None runs the plant's own model.

    Raises:
        UnsupportedEnvError: The body is not on a free joint.
        ConfigurationError: The model alone has a joint that the plant's has not, other actuators or another timestep.
    """

    def __init__(self, plant: MujocoPlant, body: str, alone: mujoco.MjModel | None = None) -> None:
        self._plant = plant
        self._model: Any = alone if alone is not None else plant.model
        m, whole = self._model, plant.model
        if m.opt.timestep != whole.opt.timestep:
            wanted = f"the machine's own model must take the env's physics steps of {whole.opt.timestep} s"
            raise ConfigurationError(f"{wanted}, it has {m.opt.timestep} s")
        index = plant.named("body", body)
        joint = int(whole.body_jntadr[index])
        if joint < 0 or whole.jnt_type[joint] != int(mujoco.mjtJoint.mjJNT_FREE):
            raise UnsupportedEnvError(f"body {body!r} must move freely (a free joint)")
        self._own = alone is not None
        if [m.actuator(i).name for i in range(m.nu)] != [whole.actuator(i).name for i in range(whole.nu)]:
            raise ConfigurationError("the machine's own model must have the env's actuators, in their order")
        self._qpos = np.concatenate([_addresses(m, plant, j, "qpos") for j in range(m.njnt)])
        self._qvel = np.concatenate([_addresses(m, plant, j, "dof") for j in range(m.njnt)])
        self._at = int(m.jnt_qposadr[m.body(body).jntadr[0]])
        self._moving = int(m.jnt_dofadr[m.body(body).jntadr[0]])
        self._pose = self._qpos[self._at : self._at + 7]
        self._motion = self._qvel[self._moving : self._moving + 6]
        self._data = mujoco.MjData(m)
        self._none = plant.controls(np.zeros(m.nu))
        self._adopt()

    def _adopt(self) -> None:
        """Copy the plant's masses, damping, friction and motors into the model that is stepped."""
        if not self._own:
            return
        m, whole = self._model, self._plant.model
        for count, kind, fields in _ADOPTED:
            for i in range(getattr(m, count)):
                name = mujoco.mj_id2name(m, kind, i)
                j = mujoco.mj_name2id(whole, kind, name) if name else -1
                for field in fields if j >= 0 else ():
                    getattr(m, field)[i] = getattr(whole, field)[j]
        m.dof_damping[:] = whole.dof_damping[self._qvel]
        mujoco.mj_setConst(m, self._data)

    def start(self) -> Course:
        """The present pose, as a course of one instant."""
        return _course(self._plant.qpos[self._pose][None], False)

    def velocity(self) -> Array:
        """Of the body's origin along world x and y, m/s, shape (2,)."""
        velocity: Array = self._plant.qvel[self._motion[:2]]
        return velocity

    def speed(self, turning_radius: float) -> float:
        """Present speed of its origin, plus that of a point at this distance as it turns, m/s."""
        vx, vy, _, wx, wy, wz = self._plant.qvel[self._motion].tolist()
        return math.hypot(vx, vy) + math.sqrt(wx * wx + wy * wy + wz * wz) * turning_radius

    def run(self, control: Array, horizon: int, turning_radius: float) -> Course:
        """Hold a control, shape (nu,), for one control interval, then none to rest, or to `horizon` >= 1 intervals.

        `turning_radius`, m, is the distance of the machine's farthest point from its origin.
        """
        plant, m, data, n, at = self._plant, self._model, self._data, self._plant.substeps, self._at
        now = plant.pose()
        data.qpos[:], data.qvel[:] = now.qpos[self._qpos], now.qvel[self._qvel]
        data.qacc_warmstart[:] = now.qacc_warmstart[self._qvel]
        data.ctrl[:] = plant.controls(control)
        poses, rests = np.empty((horizon * n, 7)), False
        for hold in range(horizon):
            for i in range(hold * n, hold * n + n):
                mujoco.mj_step(m, data)
                poses[i] = data.qpos[at : at + 7]
            # Tilting counts: where it reverses a car stands for an instant, and rolls on as it tips back.
            moving, turning = data.qvel[self._moving : self._moving + 6].reshape(2, 3)
            if math.hypot(*moving) + math.hypot(*turning) * turning_radius < _REST_SPEED:
                rests = True
                break
            data.ctrl[:] = self._none
        return _course(poses[: (hold + 1) * n], rests)


def _addresses(m: mujoco.MjModel, plant: MujocoPlant, joint: int, kind: str) -> NDArray[np.intp]:
    """Indices of a joint of the machine's own model in the plant's state ("qpos" or "dof")."""
    sizes = {"qpos": (7, 4, 1, 1), "dof": (6, 3, 1, 1)}[kind]
    addresses = plant.model.jnt_qposadr if kind == "qpos" else plant.model.jnt_dofadr
    first = int(addresses[plant.named("joint", m.joint(joint).name)])
    return np.arange(first, first + sizes[int(m.jnt_type[joint])])


def _course(poses: Array, rests: bool) -> Course:
    w, x, y, z = poses[:, 3:7].T
    to_x, to_y = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z)
    return Course(
        poses[:, :2], np.column_stack([to_x, to_y]) / np.sqrt(to_x * to_x + to_y * to_y)[:, None], rests
    )
