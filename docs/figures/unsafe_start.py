"""An episode that starts inside a hazard: what is reported while the filter drives out."""

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _style import FORBIDDEN, ON, panels

LAYOUT = {"agent": [0.05, 0.0, 0.6], "goal": [1.5, 1.0], "hazards": [[0.0, 0.0]], "vases": []}


def draw() -> Figure:
    """The reported margin over time; the policy pushes straight ahead and turns."""
    figure, ax = panels(width=5.2, height=2.5)
    env = sw.protect(gym.make("SafePointGoal1-v0"))
    env.reset(seed=0, options={"layout": LAYOUT})
    infos = [env.step(np.array([-1.0, 0.3]))[4] for _ in range(75)]
    time = np.arange(len(infos)) * env.plant.control_dt
    margin = 100.0 * np.array([i["cbf/margin"] for i in infos])
    unsafe = np.array([i["cbf/unsafe"] for i in infos])
    ax.plot(time, margin, color=ON)
    ax.plot(time[unsafe], margin[unsafe], ".", color=FORBIDDEN, ms=4, label="cbf/unsafe")
    ax.axhline(0.0, color=FORBIDDEN, lw=1.2)
    ax.set(xlabel="time (s)", ylabel="cbf/margin (cm)")
    ax.legend(loc="lower right")
    return figure
