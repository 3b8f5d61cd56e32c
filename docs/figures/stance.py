"""What the whole-body program changes, by the friction that it may count on: pyramids and the exact cone."""

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _ant import gait
from _style import ON, OTHER, panels
from safe_wrappers.filter.bound import Bound

BEFORE = 16
"""Control steps of the gait, after which a foot stands and the next torques would make it slide."""
SHARES = np.linspace(0.05, 1.0, 39)


def draw() -> Figure:
    """Distance of the answer from the gait's torques over the share of friction."""
    env = gym.make("Ant-v5", healthy_z_range=(0.1, 2.0))
    env.reset(seed=0)
    act = gait(env)
    for step in range(BEFORE):
        env.step(act(step))
    plant = sw.MujocoPlant()
    plant.bind(env)
    plant.observe()
    wanted = act(BEFORE).astype(np.float64)
    figure, ax = panels()
    for options, color, label in (
        ({}, OTHER, "pyramids"),
        ({"cone": "exact"}, ON, "exact cone"),
    ):
        distances = []
        for share in SHARES:
            stance = Bound(sw.constraints.Stance(float(share), **options), plant)
            stance.observe({})
            stance.admits(wanted)
            (answer,) = stance.candidates(wanted)
            distances.append(np.linalg.norm(answer - wanted) if stance.admits(answer) else np.nan)
        ax.plot(SHARES, distances, color=color, label=label)
    ax.set(xlabel="share of the model's friction", ylabel="correction of the torques")
    ax.legend(loc="upper right")
    env.close()
    return figure
