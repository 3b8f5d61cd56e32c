"""Three cars over an episode: when each is seen, what is believed of it, and when that may not be relied on."""

import math
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from _crossing import STEP_S, TOLERANCE_M, tracked, turn_to
from _style import FORBIDDEN, INK, OFF, ON, panels

STEPS = 250
TOP = 0.72
"""m: of the panels; the strip is above."""
LAYOUT = {
    "agent": [-0.4, -2.9, math.pi / 2],
    "goal": [1.6, 2.9],
    "cars": [[-0.9, 1.0], [-8, 1], [-9, 1], [3.6, -1.0], [5.6, -1.0], [9, -1]],
    "pillars": [[-1.15, -1.9], [0.6, -1.9], [-1.5, 1.9], [0.9, 1.9]],
}


def run() -> tuple[Any, Any, Any, Any]:
    """Errors along the lane, sigmas, seen and expired, each of shape (steps, 3)."""
    env = tracked("car0", "car3", "car4")
    env.reset(seed=3, options={"layout": LAYOUT})
    errors, infos = [], []
    for k in range(STEPS):
        heading = math.pi / 2 + (0.9 if 90 < k < 170 else 0.0)
        infos.append(env.step(np.array([0.0, 0.0, turn_to(env, heading)]))[4])
        errors.append(env.tracking.positions[:, 0] - env.unwrapped.car_positions[[0, 3, 4], 0])
    of = ("occlusion/sigma", "occlusion/visible", "occlusion/expired")
    return np.array(errors), *(np.array([info[key] for info in infos]) for key in of)


def draw() -> Figure:
    """A panel per car."""
    errors, sigmas, seen, expired = run()
    figure, axes = panels(rows=3, height=5.2, sharex=True)
    times = STEP_S * np.arange(1, STEPS + 1)
    for i, (ax, name) in enumerate(zip(axes, ("car0", "car3", "car4"), strict=True)):
        band = np.minimum(3.0 * sigmas[:, i], TOP)
        ax.fill_between(times, -band, band, color=ON, alpha=0.22, lw=0, label=r"$\pm 3\,\sigma$")
        ax.plot(times, errors[:, i], color=INK, lw=1.1, label="true error")
        for side in (-TOLERANCE_M, TOLERANCE_M):
            ax.axhline(side, color=FORBIDDEN, lw=1.0)
        lost = expired[:, i]
        for mask, low, high, color, alpha, label in (
            (seen[:, i], TOP + 0.02, TOP + 0.14, ON, 0.9, "seen"),
            (~seen[:, i], TOP + 0.02, TOP + 0.14, OFF, 0.4, "not seen"),
            (lost, -TOP, TOP, FORBIDDEN, 0.12, "permission expired"),
        ):
            ax.fill_between(
                times, low, high, where=mask, color=color, alpha=alpha, lw=0, step="mid", label=label
            )
        ax.set(ylim=(-TOP, TOP + 0.14), ylabel=f"{name}: error (m)")
    axes[0].legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=5)
    axes[-1].set_xlabel("time (s)")
    axes[-1].set_xlim(0.0, times[-1])
    return figure
