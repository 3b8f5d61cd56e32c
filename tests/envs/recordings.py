"""The recorded episodes in tests/data, in our coordinates, and how to replay them one step at a time.

Each file holds one episode of 300 control steps from Safety-Gymnasium 1.2 on MuJoCo 2.3.3: the states before
each step and after the last one, the solver's warm start, actions, observations, rewards, costs and goals.
The original point's joints are relative to where it started (`origin`: x, y, heading), ours are in world
coordinates: `Recording` rotates and shifts the first three joints, and nothing else. The car's are the same.
"""

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

DATA = Path(__file__).parents[1] / "data"
EPISODES = [(1, 1), (1, 2), (2, 1), (2, 2)]
"""Level and episode of every recording."""


@dataclass
class Recording:
    """One episode; T = 300. States, observations and goals have T + 1 rows, the rest T."""

    level: int
    qpos: np.ndarray
    qvel: np.ndarray
    obs: np.ndarray
    warmstart: np.ndarray
    action: np.ndarray
    reward: np.ndarray
    cost: np.ndarray
    goal_met: np.ndarray
    goal: np.ndarray
    hazards: np.ndarray

    @classmethod
    def load(cls, level, episode, robot="point"):
        with np.load(DATA / f"{robot}_goal{level}_ep{episode}.npz") as file:
            arrays = {name: file[name] for name in file.files}
        arrays["warmstart"] = arrays["warmstart"].astype(np.float64)
        if "origin" in arrays:
            x, y, heading = arrays.pop("origin")
            rotation = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
            for name in ("qpos", "qvel", "warmstart"):
                arrays[name][:, :2] = arrays[name][:, :2] @ rotation.T
            arrays["qpos"][:, :3] += x, y, heading
        return cls(level=level, **arrays)

    def __len__(self):
        return len(self.action)

    def vases(self, t):
        """Vase centres before step t, shape (n, 2)."""
        n_vases = 1 if self.level == 1 else 10
        return self.qpos[t, -7 * n_vases :].reshape(-1, 7)[:, :2]


@dataclass
class StepErrors:
    """Largest absolute error per quantity of one replayed step, and what was touched in it."""

    position: float
    velocity: float
    sensors: float
    lidar: float
    reward: float
    cost: float
    touched: bool


def replay(env, recording, monkeypatch, touching, mj_step=mujoco.mj_step):
    """Replay every recorded step from its recorded state, by `mj_step`; one `StepErrors` per step.

    A step counts as touched if `touching(env)` was true after one of its substeps.
    """
    layout = {"goal": recording.goal[0], "hazards": recording.hazards, "vases": recording.vases(0)}
    env.reset(seed=0, options={"layout": layout})
    assert len(recording) == 300
    touched = []

    def watched_step(model, data):
        mj_step(model, data)
        touched.append(touching(env))

    monkeypatch.setattr(mujoco, "mj_step", watched_step)
    errors = []
    for t in range(len(recording)):
        touched.clear()
        env.place_goal(recording.goal[t])
        env.set_state(recording.qpos[t], recording.qvel[t])
        env.data.qacc_warmstart[:] = recording.warmstart[t]
        _, reward, terminated, truncated, info = env.step(recording.action[t])
        assert len(touched) == env.frame_skip and not (terminated or truncated)
        assert info["goal_met"] == recording.goal_met[t]
        env.place_goal(recording.goal[t + 1])  # ours draws another new goal: look at theirs instead
        error = np.abs(env.observe() - recording.obs[t + 1])
        errors.append(
            StepErrors(
                position=np.abs(env.data.qpos - recording.qpos[t + 1]).max(),
                velocity=np.abs(env.data.qvel - recording.qvel[t + 1]).max(),
                sensors=error[: env.robot.n_sensors].max(),
                lidar=error[env.robot.n_sensors :].max(),
                reward=abs(reward - recording.reward[t]),
                cost=abs(info["cost"] - recording.cost[t]),
                touched=any(touched) or touching(env),
            )
        )
    return errors


# What MuJoCo 2.3.3 did where two boxes touch, put back into the MuJoCo of today. It reported half of the true
# penetration wherever the touched face belongs to the second box. So did all versions up to 3.3; from 3.4 on MuJoCo
# reports all of it, and from 3.12 on it finds the contact points in another way.

HALVES_ITSELF = mujoco.mj_version() < 340
OTHER_CORNERS = mujoco.mj_version() >= 3_012_000
"""Whether two boxes may touch in other points than in 2.3.3 (one corner instead of two, say), at the same depth."""


def step_as_2_3_3(model, data):
    mujoco.mj_step1(model, data)
    if halve_penetrations(model, data):
        mujoco.mj_fwdVelocity(model, data)
    mujoco.mj_step2(model, data)


def forward_as_2_3_3(model, data):
    mujoco.mj_fwdPosition(model, data)
    halve_penetrations(model, data)
    mujoco.mj_sensorPos(model, data)
    mujoco.mj_fwdVelocity(model, data)
    mujoco.mj_sensorVel(model, data)
    mujoco.mj_fwdActuation(model, data)
    mujoco.mj_fwdAcceleration(model, data)
    mujoco.mj_fwdConstraint(model, data)
    mujoco.mj_rnePostConstraint(model, data)
    mujoco.mj_sensorAcc(model, data)


def halve_penetrations(model, data):
    """Halve the depth of box-box contacts on a face of the second box; whether there were any to halve."""
    if HALVES_ITSELF:
        return False
    pairs = data.contact.geom
    boxes = (model.geom_type[pairs] == mujoco.mjtGeom.mjGEOM_BOX).all(axis=1)
    normals = data.contact.frame[:, :3]
    first, second = (
        np.abs(np.einsum("nij,ni->nj", data.geom_xmat[pairs[:, side]].reshape(-1, 3, 3), normals)).max(axis=1)
        for side in (0, 1)
    )
    halved = boxes & (second > first) & (second > 1.0 - 1e-12)
    if not halved.any():
        return False
    data.contact.dist[halved] *= 0.5
    mujoco.mj_makeConstraint(model, data)
    mujoco.mj_island(model, data)
    mujoco.mj_projectConstraint(model, data)
    return True
