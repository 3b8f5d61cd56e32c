"""Arms whose manipulability is looked at after every physics substep, by MuJoCo's own Jacobian and an SVD."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

import safe_wrappers as sw

_FETCH = (
    "shoulder_pan",
    "shoulder_lift",
    "upperarm_roll",
    "elbow_flex",
    "forearm_roll",
    "wrist_flex",
    "wrist_roll",
)
_PUSHER = (
    "r_shoulder_pan",
    "r_shoulder_lift",
    "r_upper_arm_roll",
    "r_elbow_flex",
    "r_forearm_roll",
    "r_wrist_flex",
)


@dataclass(frozen=True)
class Arm:
    """An arm and its task.

    Attributes:
        env_id: Of the env.
        kind: Of the frame that the task moves: "site", "body" or "geom".
        frame: Its name.
        joints: That do the task.
        rows: Of the twist (three of translation, three of rotation).
        task: How `SingularityMargin` is told the same.
        task_speed: That the threshold is validated for, m/s.
        rate_limit: Likewise, rad/s.
        horizon: Of the forecast.
        length: By which a rotation counts, m.
    """

    env_id: str
    kind: str
    frame: str
    joints: tuple[str, ...]
    rows: tuple[int, ...]
    task: dict[str, Any]
    task_speed: float
    rate_limit: float
    horizon: int
    length: float = 1.0
    options: dict[str, Any] = field(default_factory=dict)

    def make(self) -> Any:
        """The env, unfiltered, without an end."""
        if self.env_id.startswith("Fetch"):
            import gymnasium_robotics

            gym.register_envs(gymnasium_robotics)
        return gym.make(self.env_id, max_episode_steps=10**9, disable_env_checker=True)

    def margin(self, **more: Any) -> sw.constraints.SingularityMargin:
        """The constraint, its threshold validated when it is bound."""
        named = {self.kind: self.frame, "joints": list(self.joints), **self.task}
        chosen = {"task_speed": self.task_speed, "rate_limit": self.rate_limit, "horizon": self.horizon}
        return sw.constraints.SingularityMargin(**(named | chosen | more))


ARMS = {
    "Reacher": Arm(
        "Reacher-v5",
        "body",
        "fingertip",
        ("joint0", "joint1"),
        (0, 1),
        {"directions": "xy"},
        task_speed=0.1,
        rate_limit=5.0,
        horizon=8,
    ),
    "Pusher": Arm(
        "Pusher-v5",
        "geom",
        "tip_arml",
        tuple(f"{name}_joint" for name in (*_PUSHER, "r_wrist_roll")),
        (0, 1, 2),
        {},
        task_speed=0.2,
        rate_limit=5.0,
        horizon=8,
    ),
    "Fetch": Arm(
        "FetchReach-v4",
        "site",
        "robot0:grip",
        tuple(f"robot0:{name}_joint" for name in _FETCH),
        (0, 1, 2, 3, 4, 5),
        {"rotations": "xyz", "length": 0.3},
        task_speed=0.1,
        rate_limit=3.0,
        horizon=5,
        length=0.3,
    ),
}
"""Fetch's hand keeps its orientation (the env's weld holds it): its task has six directions."""


class Truth:
    """What is true of an arm.

    Args:
        arm: Which.
        env: Its env, or a wrapper of it.
    """

    def __init__(self, arm: Arm, env: Any) -> None:
        self._raw = env.unwrapped
        self.model: mujoco.MjModel = self._raw.model
        self._still = mujoco.MjData(self.model)
        ids = [self.model.joint(name).id for name in arm.joints]
        self.qpos, self.dofs = self.model.jnt_qposadr[ids], self.model.jnt_dofadr[ids]
        self.frame = getattr(self.model, arm.kind)(arm.frame).id
        self._rows, self._kind = list(arm.rows), arm.kind
        self._scale = np.array([1.0, 1.0, 1.0, arm.length, arm.length, arm.length])[self._rows, None]

    def jacobian(self, qpos: np.ndarray) -> np.ndarray:
        """The task's, by MuJoCo, at whole positions of shape (nq,)."""
        model, data = self.model, self._still
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        twist = np.zeros((6, model.nv))
        call = {"body": mujoco.mj_jacBody, "site": mujoco.mj_jacSite, "geom": mujoco.mj_jacGeom}[self._kind]
        call(model, data, twist[:3], twist[3:], self.frame)
        return np.asarray(twist[self._rows][:, self.dofs] * self._scale)

    def w(self, qpos: np.ndarray) -> float:
        """Manipulability: the product of the Jacobian's singular values."""
        return float(np.prod(np.linalg.svd(self.jacobian(qpos), compute_uv=False)))

    def place(self) -> np.ndarray:
        """Where the frame is at the env's present state, m; MuJoCo's own lags a substep behind."""
        self._still.qpos[:] = self._raw.data.qpos
        mujoco.mj_kinematics(self.model, self._still)
        origin = {"body": "xpos", "site": "site_xpos", "geom": "geom_xpos"}[self._kind]
        return np.array(getattr(self._still, origin)[self.frame])

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Configurations with the joints uniform in their ranges (a turn without one), shape (count, nq)."""
        model = self.model
        ids = model.dof_jntid[self.dofs]
        limited = model.jnt_limited[ids].astype(bool)[:, None]
        low, high = np.where(limited, model.jnt_range[ids], [[-np.pi, np.pi]]).T
        qpos = np.tile(model.qpos0, (count, 1))
        qpos[:, self.qpos] = rng.uniform(low, high, (count, len(ids)))
        return qpos


@dataclass
class Substeps:
    """Of one control step.

    Attributes:
        w: Manipulability after every physics substep.
        rate: The largest joint rate of the arm after every substep, rad/s.
    """

    w: list[float] = field(default_factory=list)
    rate: list[float] = field(default_factory=list)


def watch(env: Any, truth: Truth) -> Substeps:
    """Let an env take its physics substeps one by one, and write down each of them; every step starts anew."""
    raw, seen = env.unwrapped, Substeps()
    model, data = raw.model, raw.data

    def substeps(count: int) -> None:
        seen.w.clear()
        seen.rate.clear()
        for _ in range(count):
            mujoco.mj_step(model, data)
            seen.w.append(truth.w(data.qpos))
            seen.rate.append(float(np.abs(data.qvel[truth.dofs]).max()))

    def torques(control: Any, count: int) -> None:
        data.ctrl[:] = control
        substeps(count)
        mujoco.mj_rnePostConstraint(model, data)

    hooks: dict[str, Callable[..., None]] = {
        "_step_mujoco_simulation": torques,  # Gymnasium's envs
        "_mujoco_step": lambda action: substeps(raw.n_substeps),  # gymnasium-robotics'
    }
    name = next(n for n in hooks if hasattr(raw, n))
    setattr(raw, name, hooks[name])
    return seen
