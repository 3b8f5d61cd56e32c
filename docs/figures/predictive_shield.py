"""A pendulum that is driven in the direction in which it turns, shielded by its own simulation and not."""

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _style import FORBIDDEN, OFF, ON, panels

LIMIT, STEPS = 6.0, 120


def draw() -> Figure:
    """The speed over time."""
    figure, ax = panels(height=2.6)
    shield = sw.constraints.PredictiveShield(
        lambda x: LIMIT - abs(x[2]), horizon=40, backup=lambda x: [np.clip(-4.0 * x[2], -2.0, 2.0)]
    )
    shielded = sw.CBFActionFilter(gym.make("Pendulum-v1"), [shield], plant=sw.SimulatorPlant(check_steps=50))
    for env, color, name in ((gym.make("Pendulum-v1"), OFF, "unshielded"), (shielded, ON, "shielded")):
        observation, _ = env.reset(seed=1)
        speeds = []
        for _ in range(STEPS):
            observation, *_ = env.step(np.array([2.0 if observation[2] >= 0.0 else -2.0], np.float32))
            speeds.append(float(observation[2]))
        ax.plot(0.05 * np.arange(STEPS), speeds, color=color, label=name)
    ax.axhline(LIMIT, color=FORBIDDEN, lw=1.2)
    ax.set(ylim=(0.0, 9.0), xlabel="time (s)", ylabel="speed (rad/s)")
    ax.legend(loc="lower left")
    return figure
