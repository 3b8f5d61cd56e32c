"""A robot that turns as it drives, an IMU off its axis: how far off its reckoned place is, arm left out and not."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import safe_wrappers as sw
from _crossing import STEP_S, tracked
from _style import OFF, ON, panels

STEPS = 250


def run(lever_arm: bool, fix_every_s: float | None) -> NDArray[np.float64]:
    """Error of the reckoned position after each step, m."""
    imu = sw.occlusion.Imu("eye", lever_arm=lever_arm, fix_every_s=fix_every_s)
    env = tracked(sensor=sw.occlusion.Sensor(camera="eye", imu=imu))
    raw: Any = env.unwrapped
    env.reset(seed=0, options={"layout": {"agent": [0.0, -2.9, 0.0]}})
    errors = []
    for step in range(STEPS):
        spin = 1.0 if step % 150 < 110 else -1.0
        env.step(np.array([0.3 * np.cos(0.05 * step), 0.0, spin]))
        errors.append(np.linalg.norm(env.ego_motion.position[:2] - raw.agent_position))
    return np.array(errors)


def draw() -> Figure:
    """Left: known at the reset alone. Right: pose and velocity fixed every two seconds."""
    figure, axes = panels(2, height=2.8, sharey=True)
    times = STEP_S * np.arange(1, STEPS + 1)
    for ax, fix_every_s, title in zip(
        axes, (None, 2.0), ("known at the reset", "fixed every 2 s"), strict=True
    ):
        for lever_arm, color, label in ((False, OFF, "arm left out"), (True, ON, "arm compensated")):
            ax.plot(times, run(lever_arm, fix_every_s), color=color, label=label)
        ax.set(title=title, xlabel="time (s)")
    axes[0].set_ylabel("error of own position (m)")
    axes[0].legend(loc="upper left")
    return figure
