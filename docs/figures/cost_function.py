"""A task that reports no cost, judged by a function: what it sees, and what a recorder makes of it."""

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _style import FORBIDDEN, OFF, ON, panels

STEPS, HOLD, LIMIT = 50, 5, 4.0


def too_fast(env: gym.Env) -> bool:
    """A joint of the arm turns faster than the limit."""
    return bool(np.abs(env.data.qvel[:2]).max() > LIMIT)


def draw() -> Figure:
    """Left: the faster joint of an arm, without and with a filter. Right: the cost of the episode so far."""
    figure, (speed, cost) = panels(2, height=2.6)
    controls = np.random.default_rng(1).choice([-1.0, 1.0], (STEPS // HOLD, 2)).repeat(HOLD, axis=0)
    for name, color in (("filter off", OFF), ("filter on", ON)):
        env = sw.CostFunction(gym.make("Reacher-v5"), too_fast)
        if name == "filter on":
            env = sw.CBFActionFilter(env, [sw.constraints.JointSpeedLimit(LIMIT)])
        env = sw.RecordInterventions(env)
        env.reset(seed=0)
        speeds, costs = [], []
        for control in controls.astype(np.float32):
            costs.append(env.step(control)[4]["interventions/cost"])
            speeds.append(np.abs(env.unwrapped.data.qvel[:2]).max())
        time = env.unwrapped.dt * np.arange(1, STEPS + 1)
        speed.plot(time, speeds, color=color, label=name)
        cost.step(time, costs, color=color, where="post", label=name)
    speed.axhline(LIMIT, color=FORBIDDEN, lw=1.0, ls="--")
    speed.set_ylabel("fastest joint (rad/s)")
    cost.set_ylabel("interventions/cost")
    for ax in (speed, cost):
        ax.set_xlabel("time (s)")
        ax.legend(loc="upper left")
    return figure
