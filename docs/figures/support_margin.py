"""An Ant that sways on its feet: how far its zero moment point is from the edge of its support, without and with."""

from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import safe_wrappers as sw
from _ant import STEP_S, sway
from _style import FORBIDDEN, OFF, ON
from safe_wrappers.constraints.contact.support_margin import edge_distances

STEPS, INSET = 100, 0.1


def run(filtered: bool) -> tuple[NDArray[np.float64], list[bool]]:
    """Least distance of each step, m, not a number where there is no polygon; and whether it was changed."""
    bare = gym.make("Ant-v5", healthy_z_range=(0.1, 2.0))
    env: Any = sw.CBFActionFilter(bare, [sw.constraints.SupportMargin(INSET)]) if filtered else bare
    env.reset(seed=0)
    plant = sw.MujocoPlant()
    plant.bind(bare)
    act, distances, changed = sway(env, 0.4), [], []
    for step in range(STEPS):
        action = act(step)
        plant.observe()
        info = env.step(action)[4]
        executed = np.asarray(info.get("executed_action", action), np.float64)
        distances.append(min(edge_distances(plant.contact_forecast(executed)), default=np.nan))
        changed.append(bool(info.get("cbf/intervened", False)))
    env.close()
    return np.array(distances), changed


def draw() -> Figure:
    """Distance over time; gaps where there is no polygon."""
    figure = Figure(figsize=(7.2, 3.0))
    ax = figure.subplots()
    times = STEP_S * np.arange(1, STEPS + 1)
    for filtered, color, label in ((False, OFF, "filter off"), (True, ON, "filter on")):
        distances, changed = run(filtered)
        ax.plot(times, distances, ".-", ms=4, color=color, label=label)
        if filtered:
            ax.plot(times[changed], np.full(sum(changed), -0.03), "|", color=ON, ms=7)
    ax.axhline(INSET, color=FORBIDDEN, lw=1.2)
    ax.text(0.05, INSET + 0.01, "inset", color=FORBIDDEN)
    ax.set(xlabel="time (s)", ylabel="distance to the edge (m)", ylim=(-0.06, 0.5))
    ax.legend(loc="upper right")
    return figure
