"""Ant-v5 on a clumsy gait: each leg swings, lifts and comes down, out of step with its neighbours."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.plants.mujoco.contacts import Replay

STEP_S = 0.05
_PERIOD_S = 0.83
_LEANING = np.array([1.0, -1.0, -1.0, 1.0])
"""Which way each leg's ankle bends."""


def gait(env: Any) -> Callable[[int], NDArray[np.float32]]:
    """Hips swing, ankles lift while they do; a torque for each joint's error."""
    raw = env.unwrapped
    m = raw.model
    joints = [int(j) for j in m.actuator_trnid[:, 0]]
    leg = np.array([int(m.joint(j).name[-1]) - 1 for j in joints])
    hip = np.array([m.joint(j).name.startswith("hip") for j in joints])
    qpos, dofs = m.jnt_qposadr[joints], m.jnt_dofadr[joints]

    def act(step: int) -> NDArray[np.float32]:
        phase = 2.0 * np.pi * STEP_S * step / _PERIOD_S + np.pi * (np.arange(4) % 2)
        lifted = 0.9 - 0.3 * np.maximum(np.cos(phase), 0.0)
        wanted = np.where(hip, 0.35 * np.sin(phase)[leg], (_LEANING * lifted)[leg])
        torque = 1.2 * (wanted - raw.data.qpos[qpos]) - 0.05 * raw.data.qvel[dofs]
        return np.clip(torque, -1.0, 1.0).astype(np.float32)

    return act


def walk(
    wrap: Callable[[Any], Any], steps: int
) -> tuple[list[NDArray[np.float64]], list[dict[str, Any]], float]:
    """Per step the normal and tangential force of each contact with the floor, over the weight; infos; metres."""
    env = wrap(gym.make("Ant-v5", healthy_z_range=(0.1, 2.0)))
    raw = env.unwrapped
    env.reset(seed=0)
    replay, act = Replay(raw), gait(env)
    weight = float(raw.model.body_mass.sum() * 9.81)
    fixed = raw.model.body_weldid == 0
    forces, infos, wrench = [], [], np.zeros(6)
    for step in range(steps):
        replay.before()
        infos.append(env.step(act(step))[4])
        found: list[tuple[float, float]] = []

        def visit(data: mujoco.MjData, _: float, found: list[tuple[float, float]] = found) -> None:
            for i in range(data.ncon):
                first, second = raw.model.geom_bodyid[data.contact.geom[i]]
                if fixed[first] != fixed[second]:
                    mujoco.mj_contactForce(raw.model, data, i, wrench)
                    found.append((wrench[0] / weight, float(np.hypot(*wrench[1:3])) / weight))

        replay.after(visit)
        forces.append(np.array(found).reshape(-1, 2))
    metres = float(raw.data.qpos[0])
    env.close()
    return forces, infos, metres
