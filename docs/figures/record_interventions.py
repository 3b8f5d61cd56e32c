"""What one recorded episode looks like: corrections step by step, and their means so far."""

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _style import OFF, ON, OTHER, panels
from first_look import towards_goal

STEPS = 500


def draw() -> Figure:
    """Left: the correction of every step. Right: rate and mean correction of the episode so far."""
    figure, (steps, running) = panels(2, height=2.6)
    env = sw.RecordInterventions(sw.protect(gym.make("SafePointGoal1-v0", max_episode_steps=STEPS)))
    env.reset(seed=3)
    infos = [env.step(towards_goal(env.unwrapped))[4] for _ in range(STEPS)]
    time = np.arange(STEPS) * 0.02
    steps.fill_between(time, [i["cbf/correction"] for i in infos], step="mid", color=ON, alpha=0.8, lw=0)
    steps.set_ylabel("cbf/correction")
    count = np.arange(1, STEPS + 1)
    rate = np.cumsum([i["cbf/intervened"] for i in infos]) / count
    running.plot(time, rate, color=OFF, label="intervention_rate")
    mean = np.cumsum([i["cbf/correction"] for i in infos]) / count
    running.plot(time, mean, color=OTHER, label="correction_mean")
    running.legend(loc="upper left")
    running.set_ylim(0.0, 1.0)
    for ax in (steps, running):
        ax.set_xlabel("time (s)")
    return figure
