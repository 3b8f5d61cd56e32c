"""Gymnasium's Reacher arm before a wall that is a spring: an env whose contact forces are known at every substep.

MuJoCo's contacts are soft constraints with a reference acceleration `a_ref = -b v - k_ref x`, solved with a
regularisation `(1 - d) / d` times the constraint's own inverse mass. With a constant impedance d near 0 the contact
is a plain spring: the normal force is `k x` with

    k = |solref[0]| / diagApprox,    diagApprox = body_invweight0 of both bodies (1/kg),

whatever the pose, because MuJoCo takes `diagApprox` from the pose of reference. So a physical stiffness k needs
`solref = (-k diagApprox, 0)`. Near 1 the impedance makes the contact rigid instead: the force then first cancels what
pushes, and k is a stiffness of the correction only. MuJoCo clamps d at 0.0001.
"""

from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

TIMESTEP_S = 0.002
SUBSTEPS = 10
"""A control step of 20 ms, as Reacher's."""
IMPEDANCE = 0.001
REACH_M = 0.21
"""Base to the fingertip's centre."""
TIP_M = 0.01
"""Its radius."""
_REACHER = Path(gym.__file__).parent / "envs" / "mujoco" / "assets" / "reacher.xml"


def springy(model: mujoco.MjModel, geom: str, body: str, stiffness: float) -> None:
    """Make contacts of a geom of the world with a body's geoms a spring without damping.

    Args:
        model: Changed in place; the contact must be frictionless (condim 1).
        geom: Its name; it gets the higher priority, so that its parameters count.
        body: Name of the body that touches it.
        stiffness: N/m.
    """
    wall = model.geom(geom).id
    model.geom_priority[wall] = 1
    model.geom_solref[wall] = -stiffness * model.body(body).invweight0[0], 0.0
    model.geom_solimp[wall] = IMPEDANCE, IMPEDANCE, 0.001, 0.5, 2.0


def arm_model(stiffness: float, payload: float = 0.0, timestep: float = TIMESTEP_S) -> mujoco.MjModel:
    """Reacher with a wall ("wall", a mocap body) that its fingertip alone can touch.

    Args:
        stiffness: Of the wall, N/m.
        payload: Added to the fingertip, kg.
        timestep: s.
    """
    spec = mujoco.MjSpec.from_file(str(_REACHER))
    spec.option.timestep = timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    for geom in spec.geoms:
        geom.conaffinity = int(geom.name == "fingertip")
        geom.condim = 1
    if payload:
        tip = spec.body("fingertip")
        tip.add_geom(
            name="payload", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.005, 0, 0], mass=payload, contype=0,
            conaffinity=0,
        )  # fmt: skip
    wall = spec.worldbody.add_body(name="wall", mocap=True, pos=[1.0, 0.0, 0.01])
    wall.add_geom(
        name="wall", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.2, 1.0, 0.2], contype=1, conaffinity=0, condim=1
    )
    model = spec.compile()
    springy(model, "wall", "fingertip", stiffness)
    return model


class ArmAndWall(gym.Env[np.ndarray, np.ndarray]):
    """The arm, torques as actions.

    `reset(options=...)` takes "qpos", "qvel" (2,), and the wall's "angle" and "distance": it is a plane at a distance
    (m) from the base, seen in a direction (rad).

    Args:
        stiffness: Of the wall, N/m.
        payload: At the fingertip, kg.

    Attributes:
        forces: Normal forces of the last control step, shape (substeps,), N; of the states that each substep began
            with, so that a peak is sampled every 2 ms.
    """

    def __init__(self, stiffness: float, payload: float = 0.0) -> None:
        self.model = arm_model(stiffness, payload)
        self.data = mujoco.MjData(self.model)
        self.frame_skip, self.dt = SUBSTEPS, SUBSTEPS * TIMESTEP_S
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float64)
        self.forces = np.zeros(SUBSTEPS)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """At rest, stretched out, the wall out of reach, unless the options say otherwise."""
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        given = options or {}
        self.data.qpos[:2] = given.get("qpos", (0.0, 0.0))
        self.data.qvel[:2] = given.get("qvel", (0.0, 0.0))
        angle, distance = given.get("angle", 0.0), given.get("distance", 1.0)
        self.normal = np.array([np.cos(angle), np.sin(angle), 0.0])
        self.distance = distance
        self.data.mocap_pos[0] = (distance + 0.2) * self.normal + [0.0, 0.0, 0.01]
        self.data.mocap_quat[0] = np.cos(angle / 2.0), 0.0, 0.0, np.sin(angle / 2.0)
        self.forces[:] = 0.0
        mujoco.mj_forward(self.model, self.data)
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Hold the torques for a control step."""
        self.data.ctrl[:] = action
        for i in range(SUBSTEPS):
            mujoco.mj_step(self.model, self.data)
            self.forces[i] = normal_force(self.data)
        return self._observation(), 0.0, False, False, {}

    def _observation(self) -> np.ndarray:
        return np.concatenate([self.data.qpos[:2], self.data.qvel[:2]])


def normal_force(data: mujoco.MjData) -> float:
    """Of all contacts together, N: of a frictionless one the constraint's force is the normal force."""
    return float(data.efc_force[data.contact.efc_address[: data.ncon]].sum()) if data.ncon else 0.0
