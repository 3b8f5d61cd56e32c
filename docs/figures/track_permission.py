"""A robot that drives beside the road, looks away from a car for a while, and has to stop until it looks again."""

import math

import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _crossing import STEP_S, car_tracks, tracked, turn_to
from _style import FORBIDDEN, INK, OFF, ON

STEPS = 185
ASKED = 0.6
"""m/s."""
TOLERANCE = 0.4
"""m."""
LOOKS_AWAY = (30, 130)
"""Steps."""
LAYOUT = {
    "agent": [-2.5, -2.9, math.pi / 2],
    "cars": [[-2.8, 0.7], [-8, 1], [-9, 1], [8, -1], [9, -1], [10, -1]],
    "pillars": [[-3.3, -1.9], [3.3, -1.9], [-3.3, 2.3], [3.3, 2.3]],
}


def draw() -> Figure:
    """Top: what is seen, three sigma and the tolerance. Bottom: asked and driven speed."""
    env = tracked(car_tracks("car0"), tolerance=TOLERANCE)
    env = sw.CBFActionFilter(env, [sw.constraints.TrackPermission("robot", braking=3.0)])
    env.reset(seed=1, options={"layout": LAYOUT})
    sigmas, seen, expired, speeds = [], [], [], []
    for k in range(STEPS):
        raw = env.unwrapped
        away = LOOKS_AWAY[0] <= k < LOOKS_AWAY[1]
        ahead = raw.car_positions[0] - raw.agent_position
        heading = -math.pi / 2 if away else math.atan2(ahead[1], ahead[0])
        force = 0.5 * ASKED + 1.0 * (ASKED - raw.agent_velocity[0])
        info = env.step(np.array([np.clip(force, -1.0, 1.0), 0.0, turn_to(env, heading)]))[4]
        for rows, key in ((sigmas, "sigma"), (seen, "visible"), (expired, "expired")):
            rows.append(info[f"occlusion/{key}"][0])
        speeds.append(raw.agent_velocity[0])
    times = STEP_S * np.arange(1, STEPS + 1)
    figure = Figure(figsize=(7.2, 3.9))
    above, below = figure.subplots(2, 1, sharex=True)
    above.plot(times, 3.0 * np.array(sigmas), color=INK, label=r"$3\,\sigma$ of the car")
    above.axhline(TOLERANCE, color=FORBIDDEN, lw=1.2)
    above.text(6.3, 0.44, "tolerance", color=FORBIDDEN)
    for mask, color in ((np.array(seen), ON), (~np.array(seen), OFF)):
        above.fill_between(times, 0.94, 1.0, where=mask, color=color, alpha=0.7, lw=0, step="mid")
    below.plot(times, speeds, color=ON, label="driven")
    below.axhline(ASKED, color=OFF, lw=1.2, ls="--", label="asked for")
    for ax in (above, below):
        ax.fill_between(times, 0.0, 1.0, where=expired, color=FORBIDDEN, alpha=0.12, lw=0, step="mid")
    above.set_ylim(0.0, 1.0)
    below.set_ylim(-0.05, 0.8)
    above.set_ylabel("error bound (m)")
    below.set(ylabel="speed (m/s)", xlabel="time (s)")
    above.legend(loc="center left")
    below.legend(loc="lower left")
    return figure
