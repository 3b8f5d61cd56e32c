"""A robot that turns on the spot, its camera off the axis: where it takes a car to be, knowing so and not."""

import math
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import safe_wrappers as sw
from _crossing import STEP_S, tracked
from _style import GRID, INK, OFF, ON, panels

STEPS = 100
ARM = 0.15
"""m, of the eye ahead of the axis."""
LAYOUT = {
    "agent": [0.0, -2.9, 0.0],
    "cars": [[-2.0, 1.0], [-8, 1], [-9, 1], [8, -1], [9, -1], [10, -1]],
    "pillars": [[-3.2, -2.3], [3.2, -2.3], [-3.2, 2.3], [3.2, 2.3]],
}


def run(lever_arm: bool) -> tuple[Any, Any]:
    """Estimated minus true position, shape (steps, 2), and its sigma."""
    eye = sw.occlusion.Sensor(camera="eye", view_deg=360, position_std=0.02, lever_arm=lever_arm)
    walker = sw.occlusion.Track("car0", acceleration_noise=0.5, start_position_std=0.05)
    env = tracked([walker], eye)
    env.reset(seed=0, options={"layout": LAYOUT})
    errors, sigmas = [], []
    for _ in range(STEPS):
        info = env.step(np.array([0.0, 0.0, 1.0]))[4]
        errors.append(env.tracking.positions[0] - env.unwrapped.car_positions[0])
        sigmas.append(info["occlusion/sigma"][0])
    return np.array(errors), np.array(sigmas)


def draw() -> Figure:
    """Left: the error along x over time, with the band that the estimate claims. Right: in the plane."""
    figure, (left, right) = panels(2, height=3.0, width_ratios=[3, 2])
    times = STEP_S * np.arange(1, STEPS + 1)
    for lever_arm, color, label in ((False, OFF, "arm left out"), (True, ON, "arm compensated")):
        errors, sigmas = run(lever_arm)
        if lever_arm:
            left.fill_between(times, -3.0 * sigmas, 3.0 * sigmas, color=GRID, alpha=0.3, lw=0)
        left.plot(times, errors[:, 0], color=color, label=label)
        right.plot(*errors.T, color=color, lw=1.2)
    turn: NDArray[np.float64] = np.linspace(0.0, math.tau, 73)
    right.plot(ARM * np.cos(turn), ARM * np.sin(turn), color=INK, lw=0.9, ls=":")
    left.text(times[-1], 0.0, r" $\pm 3\,\sigma$", va="center")
    left.set(xlim=(0.0, times[-1] + 0.4), ylim=(-0.22, 0.28), xlabel="time (s)")
    left.set_ylabel("estimated minus true x (m)")
    left.legend(loc="upper left", ncols=2)
    right.set(aspect="equal", xlabel="error along x (m)", ylabel="error along y (m)")
    return figure
