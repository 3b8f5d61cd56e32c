"""The task's reward and the learner's, over one episode."""

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _style import OFF, ON, OTHER, panels
from first_look import towards_goal

STEPS = 500


def draw() -> Figure:
    """Left: the penalty of every step. Right: both rewards, summed up."""
    figure, (steps, total) = panels(2, height=2.6)
    env = sw.protect(gym.make("SafePointGoal1-v0", max_episode_steps=STEPS))
    env = sw.AdaptionPenalty(env, penalty=0.005, per_correction=0.005)
    env.reset(seed=3)
    infos, rewards = [], []
    for _ in range(STEPS):
        _, reward, _, _, info = env.step(towards_goal(env.unwrapped))
        infos.append(info)
        rewards.append(reward)
    time = np.arange(STEPS) * 0.02
    steps.fill_between(time, [i["adaption/penalty"] for i in infos], step="mid", color=OTHER, alpha=0.8, lw=0)
    steps.set_ylabel("adaption/penalty")
    total.plot(
        time, np.cumsum([i["adaption/task_reward"] for i in infos]), color=ON, label="the task's reward"
    )
    total.plot(time, np.cumsum(rewards), color=OFF, label="the learner's")
    total.set_ylabel("sum so far")
    total.legend(loc="upper left")
    for ax in (steps, total):
        ax.set_xlabel("time (s)")
    return figure
