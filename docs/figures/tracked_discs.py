"""The crossing from above: cars that pillars hide, and the sets that standard deviations make of them."""

import math

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle

import safe_wrappers as sw
from _crossing import car_tracks, road, tracked
from _style import FORBIDDEN, INK, OFF, ON, panels
from safe_wrappers.constraints.obstacles import distances

LAYOUT = {
    "agent": [-0.4, -2.9, math.pi / 2],
    "goal": [1.6, 2.9],
    "cars": [[-2.6, 1.0], [-5.2, 1.0], [-0.6, 1.0], [2.2, -1.0], [4.6, -1.0], [9, -1]],
    "pillars": [[-1.15, -1.9], [0.75, -1.9], [-1.5, 1.9], [0.9, 1.9]],
}
WATCHED = 75
"""Steps."""


def draw() -> Figure:
    """After three seconds of looking straight ahead."""
    tracks = car_tracks()
    for track in tracks:
        track.acceleration_noise = [track.acceleration_noise[0], 0.002]  # the lane is not quite certain
    env = tracked(tracks)
    env.reset(seed=4, options={"layout": LAYOUT})
    for _ in range(WATCHED):
        info = env.step(np.zeros(3))[4]
    figure, ax = panels(height=3.6)
    road(ax, env)
    plant = sw.MujocoPlant()
    plant.bind(env)
    plant.observe()
    raw = env.unwrapped
    x, y = np.meshgrid(np.linspace(-4.5, 4.5, 73), np.linspace(-2.0, 2.0, 33))
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    for sigmas in (3.0, 2.0, 1.0):
        gaps = distances(sw.constraints.TrackedDiscs(raw.car_radius, sigmas), points, plant)
        for gap in gaps.T:
            ax.contourf(x, y, gap.reshape(x.shape), levels=[-9.0, 0.0], colors=[FORBIDDEN], alpha=0.17)
    for center, mean, seen in zip(
        raw.car_positions, env.tracking.positions, info["occlusion/visible"], strict=True
    ):
        if abs(center[0]) < 4.4:
            ax.add_patch(Circle(center, raw.car_radius, fill=False, edgecolor=ON if seen else OFF, lw=1.6))
        if abs(mean[0]) < 4.4:
            ax.plot(*mean, "+", color=INK)
    for x, y, text, color in (
        (0.2, -2.95, "a car where it is, seen", ON),
        (0.2, -3.3, "and not seen", OFF),
        (-4.3, -3.3, "where its disc may be", FORBIDDEN),
    ):
        ax.text(x, y, text, color=color, va="center")
    ax.set_ylim(-3.5, 2.4)
    return figure
