"""One state in front of a hazard: where the filter sends all actions, and where the map does."""

from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _style import GRID, OFF, ON, OTHER, SAFE, panels

LAYOUT = {"agent": [0.0, 0.0, 0.0], "goal": [1.8, 0.0], "hazards": [[0.6, 0.05]], "vases": []}
STEPS = 60


def arrived(env: Any) -> Any:
    """The env after a drive straight at the hazard."""
    env.reset(seed=0, options={"layout": LAYOUT})
    for _ in range(STEPS):
        env.step(np.array([1.0, 0.0], np.float32))
    return env


def draw() -> Figure:
    """Left: the map, over the plane of actions. Right: what is executed of every drive straight on."""
    figure, (plane, drives) = panels(2, height=3.2)
    env = arrived(sw.SafeActionMap(sw.protect(gym.make("SafePointGoal1-v0"), detour=False)))
    env.mapped(np.zeros(2, np.float32))
    most = env.get_wrapper_attr("plant").acting_range[1][0]
    engine = env.get_wrapper_attr("filter")
    grid = np.linspace(-1.0, 1.0, 81)
    safe = [[engine.admits(np.array([most * drive, turn])) for turn in grid] for drive in grid]
    plane.contourf(grid, grid, np.array(safe, float), levels=[0.5, 1.5], colors=[SAFE], alpha=0.2)
    for drive in np.linspace(-1.0, 1.0, 7):
        for turn in np.linspace(-1.0, 1.0, 7):
            action = np.array([most * drive, turn], np.float32)
            sent = env.mapped(action)[0]
            plane.annotate(
                "",
                (sent[1], sent[0] / most),
                (turn, drive),
                arrowprops={"arrowstyle": "->", "color": OTHER, "lw": 0.9},
            )
            plane.plot(sent[1], sent[0] / most, "o", color=ON, ms=3)
    plane.set(xlabel="turn", ylabel="drive, as a share of what acts", aspect="equal")
    mapped, filtered = [], []
    for drive in grid:
        action = np.array([most * drive, 0.0], np.float32)
        mapped.append(env.mapped(action)[0][0] / most)
        filtered.append(engine.filter(action.astype(float)).control[0] / most)
    drives.plot(grid, grid, color=GRID, lw=1.0, ls="--")
    drives.plot(grid, filtered, color=OFF, label="filter alone")
    drives.plot(grid, mapped, color=ON, label="with the map")
    drives.set(xlabel="drive of the policy, straight on", ylabel="executed drive")
    drives.legend(loc="upper left")
    return figure
