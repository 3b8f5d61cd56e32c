"""An Ant that is dropped and sways on its feet: support, friction and momentum of every control step."""

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _ant import STEP_S, sway
from _style import FORBIDDEN, OFF, ON, OTHER, SAFE

STEPS = 80


def draw() -> Figure:
    """Shares of support and flight; margin where there is one; used friction and upward momentum."""
    env = sw.BalanceMonitor(gym.make("Ant-v5", healthy_z_range=(0.1, 2.0)))
    env.reset(seed=0)
    act = sway(env, 0.4)
    infos = [env.step(act(step))[4] for step in range(STEPS)]
    env.close()
    time = STEP_S * np.arange(1, STEPS + 1)
    supported, airborne, margin, used = (
        np.array([info[f"balance/{name}"] for info in infos])
        for name in ("supported", "airborne", "zmp_margin", "friction_used")
    )
    upwards = np.array([info["balance/linear_momentum"][2] for info in infos])
    figure = Figure(figsize=(7.2, 4.2))
    shares, distance, friction = figure.subplots(3, 1, sharex=True)
    shares.bar(time, supported, STEP_S, color=SAFE, alpha=0.7, label="supported")
    shares.bar(time, airborne, STEP_S, bottom=1.0 - airborne, color=OTHER, alpha=0.7, label="airborne")
    shares.set_ylabel("share of\nthe step")
    distance.plot(time, np.where(supported > 0.0, margin, np.nan), "o", ms=3, color=ON, label="zmp_margin")
    distance.axhline(0.0, color=FORBIDDEN, lw=1.0)
    distance.set_ylabel("to the edge\n(m)")
    friction.plot(time, used, color=OFF, lw=1.2, label="friction_used")
    friction.plot(time, upwards, color=ON, lw=1.2, label="linear_momentum, upwards (kg m/s)")
    friction.set_xlabel("time (s)")
    for ax in (shares, distance, friction):
        ax.legend(loc="upper right", ncols=2, bbox_to_anchor=(1.0, 1.32), borderaxespad=0.0)
    return figure
