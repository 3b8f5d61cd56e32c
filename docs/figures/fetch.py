"""A Fetch arm sent down into its table and along it, without the filter and with it: its way, and the forces."""

import contextlib
import io
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

import safe_wrappers as sw
from _style import FORBIDDEN, GRID, OFF, ON, panels

with contextlib.redirect_stderr(io.StringIO()):  # it greets on stderr
    import gymnasium_robotics
gym.register_envs(gymnasium_robotics)

WAYS = np.repeat(
    np.array([[-1, 0, -1, 0], [1, 0, -1, 0], [1, 0, -1, 0], [0, 0, 1, 0], [-1, 0, -1, 0]]), 6, axis=0
)


def drive(env: Any) -> tuple[np.ndarray, np.ndarray]:
    """The way of a finger's tip (x, height above the table), cm, and the force of the table, kN."""
    raw, tips, forces = env.unwrapped, [], []
    model, data = raw.model, raw.data
    finger = model.geom("robot0:l_gripper_finger_link").id
    table = int(model.body("table0").geomadr[0])
    top = data.geom_xpos[table][2] + model.geom_size[table][2]
    wrench = np.zeros(6)

    def watched(action: Any) -> None:
        for _ in range(raw.n_substeps):
            mujoco.mj_step(model, data)
            end = data.geom_xpos[finger] + 0.0385 * data.geom_xmat[finger].reshape(3, 3)[:, 0]
            tips.append(100.0 * np.array([end[0], end[2] - top]))
            force = 0.0
            for i in range(data.ncon):
                if table in data.contact.geom[i]:
                    mujoco.mj_contactForce(model, data, i, wrench)
                    force += 1e-3 * float(wrench[0])
            forces.append(force)

    raw._mujoco_step = watched
    env.reset(seed=0)
    for way in WAYS:
        env.step(way.astype(np.float32))
    return np.array(tips), np.array(forces)


def draw() -> Figure:
    """Left: from the side. Right: how hard the table pushes."""
    figure, (side, push) = panels(2, height=2.8)
    for env, color, name in (
        (gym.make("FetchReach-v4"), OFF, "unfiltered"),
        (sw.protect(gym.make("FetchReach-v4")), ON, "filtered"),
    ):
        tips, forces = drive(env)
        side.plot(*tips.T, color=color, lw=1.3, label=name)
        push.plot(0.002 * np.arange(len(forces)), forces, color=color, lw=1.3, label=name)
    side.add_patch(Rectangle((105.0, -3.0), 50.0, 3.0, color=FORBIDDEN, alpha=0.25, lw=0))
    side.set(
        xlim=(108.0, 158.0), ylim=(-1.5, 16.0), xlabel="x, cm", ylabel="finger's tip above the table, cm"
    )
    side.legend(loc="upper left")
    push.set(xlabel="time, s", ylabel="the table's force, kN")
    push.grid(color=GRID, alpha=0.25)
    return figure
