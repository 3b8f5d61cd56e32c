"""A car before a hazard: the ways to rest of three controls, and a blind drive around."""

import math
from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _style import INK, OFF, ON, SAFE, bare, disc, panels
from first_look import drive_to_goal, show_layout
from safe_wrappers.errors import Array

HAZARD = [0.92, 0.03]
LAYOUT = {"agent": [0.0, 0.0, 0.0], "goal": [1.9, 0.15], "hazards": [HAZARD], "vases": []}


def steer(task: Any) -> Array:
    """Towards the goal, blind."""
    x, y = task.goal_position - task.agent_position
    bearing = math.remainder(math.atan2(y, x) - task.agent_heading, math.tau)
    return 0.02 * np.clip([1.0 + 2.0 * bearing, 1.0 - 2.0 * bearing], 0.0, 1.0)


def ways() -> tuple[Array, list[Array]]:
    """Where the car is in the last step before its full torque is refused, and its ways to rest from there."""
    env = sw.protect(gym.make("SafeCarGoal1-v0"), detour=False)
    env.reset(seed=0, options={"layout": LAYOUT})
    constraint = env.filter.bound[0]
    while True:
        env.filter.observe()
        if not constraint.admits(np.ones(2)):
            break
        env.step(np.ones(2, dtype=np.float32))
    run = constraint.spec.coasting.run
    controls = ([1.0, 1.0], [0.0, 0.0])
    courses = [run(np.array(u), constraint.spec.horizon, 0.2).places for u in controls]
    return env.unwrapped.agent_position, courses


def draw() -> Figure:
    """Left: what is asked. Right: what comes of it."""
    figure, (close, chart) = panels(2, height=2.6, width_ratios=[1, 2])
    here, (pushing, resting) = ways()
    disc(close, HAZARD, 0.2)
    for way, color, offset, name in (
        (pushing, OFF, 0.012, "full torque"),
        (resting, ON, -0.012, "no torque"),
    ):
        close.plot(way[:, 0], way[:, 1] + offset, color=color, lw=2)
        close.plot(way[9, 0], way[9, 1] + offset, "|", color=color, ms=9)
        close.plot(way[-1, 0], way[-1, 1] + offset, "o", color=color, ms=5)
        close.text(here[0] - 0.005, here[1] + 2.6 * offset, name, color=color, ha="right", va="center")
    close.plot(here[0], here[1], "s", color=INK, ms=5)
    bare(close)
    close.set(xlim=(here[0] - 0.11, here[0] + 0.16), ylim=(-0.08, 0.08))
    show_layout(chart, LAYOUT)
    for protect, color in ((lambda env: env, OFF), (sw.protect, ON)):
        path, _ = drive_to_goal(protect(gym.make("SafeCarGoal1-v0")), LAYOUT, steer=steer)
        chart.plot(*path[:-1].T, color=color)  # until the goal
    chart.text(*LAYOUT["goal"], "goal", color=SAFE, ha="center", va="center")
    chart.plot(0.0, 0.0, "s", color=INK, ms=5)
    bare(chart)
    chart.set_xlim(-0.15, 2.25)
    return figure
