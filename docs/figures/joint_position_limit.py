"""Reacher's elbow in a range narrower than its own: position over time, and in the plane with its speed."""

import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _drivers import bang_bang, drive, sides
from _style import FORBIDDEN, panels

RANGE = 1.0


def draw() -> Figure:
    """Left: over time. Right: braking begins before the range ends, earlier when faster."""
    figure, (time, plane) = panels(2, height=2.8, width_ratios=[3, 2])
    limit = sw.constraints.JointPositionLimit(-RANGE, RANGE, joints=["joint1"], margin=0.01, horizon=10)
    for env, color, name in sides("Reacher-v5", limit):
        states, _ = drive(
            env, bang_bang(0.2, 0.05, seed=4), 200, lambda raw, info: (raw.data.qpos[1], raw.data.qvel[1])
        )
        time.plot(np.arange(len(states)) * 0.02, states[:, 0], color=color, lw=1.3, label=name)
        if name == "filtered":
            plane.plot(*states.T, color=color, lw=1.1)
    for side in (-RANGE, RANGE):
        time.axhline(side, color=FORBIDDEN, lw=1.2)
        plane.axvline(side, color=FORBIDDEN, lw=1.2)
    time.set(xlabel="time (s)", ylabel="joint position (rad)")
    time.legend(loc="upper right")
    plane.set(xlabel="joint position (rad)", ylabel="joint speed (rad/s)")
    return figure
