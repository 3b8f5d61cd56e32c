"""The stopping inset over speed, and a point mass that is steered around a disc by nothing but the projection."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle

import safe_wrappers as sw
from _cart import Cart, plant
from _style import FORBIDDEN, INK, OFF, ON, OTHER, disc, panels
from safe_wrappers.control.backup.stopping import held_stop
from safe_wrappers.errors import Array

BRAKE, HOLD, DELAY = 2.0, 0.25, 0.2
CENTER, RADIUS = (2.0, 0.12), 0.5


def to_the_right(state: Array) -> Array:
    """Hold 1.2 m/s along x and the line y = 0."""
    return np.clip([4.0 * (1.2 - state[2]), -4.0 * state[1] - 3.0 * state[3]], -3.0, 3.0)


def drive(env: Any) -> Array:
    """Positions, shape (k, 2)."""
    env.reset(seed=0)
    path = [env.unwrapped.state[:2]]
    for _ in range(140):
        env.step(to_the_right(env.unwrapped.state))
        path.append(env.unwrapped.state[:2])
    return np.array(path)


def draw() -> Figure:
    """Left: distance that must be left, over approach speed. Right: paths."""
    figure, (inset, chart) = panels(2, height=3.0, width_ratios=[3, 4])
    speed = np.linspace(0.0, 2.0, 401)
    held = np.array([held_stop(v, BRAKE, HOLD) for v in speed])
    inset.plot(speed, speed**2 / (2 * BRAKE), color=INK, ls="--", lw=1.2, label="v² / 2a")
    inset.plot(speed, held, color=ON, label="held for 0.25 s")
    inset.plot(speed, held + speed * DELAY, color=OTHER, label="and 0.2 s of delay")
    inset.fill_between(speed, 0.0, held, color=FORBIDDEN, alpha=0.12, lw=0)
    inset.set(ylim=(0.0, 1.6), xlabel="approach speed (m/s)", ylabel="stopping distance (m)")
    inset.legend(loc="upper left")
    raw = Cart((0.0, 0.0, 1.2, 0.0), 0.05, most=3.0)
    keep_out = sw.constraints.Clearance(
        [sw.constraints.Disc(CENTER, RADIUS)],
        braking=2.5,
        position=[0, 1],
        velocity=[2, 3],
        radius=0.1,
        margin=0.01,
    )
    chart.plot(*drive(raw).T, color=OFF)
    chart.plot(*drive(sw.CBFActionFilter(raw, [keep_out], plant=plant(raw))).T, color=ON)
    disc(chart, CENTER, RADIUS)
    chart.add_patch(Circle(CENTER, RADIUS + 0.1, fill=False, color=FORBIDDEN, lw=0.8, ls=":"))
    chart.set(aspect="equal", xlim=(-0.1, 4.2), xlabel="x (m)", ylabel="y (m)")
    return figure
