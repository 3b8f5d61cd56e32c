"""A cheetah that lands and runs: what a whole control step's contacts did, and what its end shows of it."""

import gymnasium as gym
import mujoco
import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _style import OFF, ON, OTHER, panels

STEPS, HOLD = 60, 3


def draw() -> Figure:
    """Left: the front foot's force, of all substeps and of the last. Right: penetration and residual."""
    figure, (force, soft) = panels(2, height=2.8)
    env = sw.ContactMonitor(gym.make("HalfCheetah-v5"), bodies=["ffoot"])
    env.reset(seed=1)
    controls = np.random.default_rng(2).uniform(-1.0, 1.0, (STEPS // HOLD, 6)).repeat(HOLD, axis=0)
    infos, last = [], []
    for control in controls:
        infos.append(env.step(control.astype(np.float32))[4])
        last.append(_left_behind(env.unwrapped))
    time = env.unwrapped.dt * np.arange(1, STEPS + 1)
    peaks = [info["contact/peak_force"] for info in infos]
    force.vlines(time, last, peaks, color=ON, lw=1.0, alpha=0.6)
    force.plot(time, peaks, "o", ms=3.5, color=ON, label="contact/peak_force")
    force.plot(time, last, "o", ms=3.5, color=OFF, label="the last substep's")
    force.set_ylabel("force on the front foot (N)")
    soft.plot(
        time, [1000.0 * info["contact/penetration"] for info in infos], color=ON, label="penetration (mm)"
    )
    soft.plot(time, [info["contact/residual"] for info in infos], color=OTHER, label="residual (N m)")
    for ax in (force, soft):
        ax.set_xlabel("time (s)")
        ax.legend(loc="upper right")
        ax.set_ylim(0.0, 1.35 * ax.get_ylim()[1])
    return figure


def _left_behind(raw: gym.Env) -> float:
    """What the env's own data says after a step."""
    wrench, total = np.zeros(6), 0.0
    for i in range(raw.data.ncon):
        if raw.model.body("ffoot").id in raw.model.geom_bodyid[raw.data.contact[i].geom]:
            mujoco.mj_contactForce(raw.model, raw.data, i, wrench)
            total += wrench[0]
    return total
