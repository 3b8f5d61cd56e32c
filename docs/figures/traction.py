"""A rover on snow that has to keep two limits at once: of its wheels' slip and of their speed."""

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _rover import FULL_THROTTLE, OPEN, STEP_S
from _style import FORBIDDEN, ON, panels

STEPS = 200
SLIP, SPEED = 0.15, 30.0


def draw() -> Figure:
    """Left: slip of a wheel. Right: its speed."""
    env = gym.make("SafeRover-v0", max_episode_steps=STEPS)
    wheels = list(env.unwrapped.wheels)
    limits = [
        sw.constraints.Traction(wheels, max_slip=SLIP),
        sw.constraints.JointSpeedLimit(SPEED, joints=wheels, margin=1.0),
    ]
    filtered = sw.CBFActionFilter(env, limits)
    filtered.reset(seed=0, options={"layout": OPEN | {"ground": "snow"}})
    rate = filtered.unwrapped.data.joint(wheels[0])
    slips, rates = [], []
    for _ in range(STEPS):
        slips.append(filtered.step(FULL_THROTTLE)[4]["slip"][0])
        rates.append(float(rate.qvel[0]))
    figure, (left, right) = panels(2, height=2.7)
    time = STEP_S * np.arange(1, STEPS + 1)
    left.plot(time, slips, color=ON)
    left.axhline(SLIP, color=FORBIDDEN, lw=1.2)
    left.set(ylim=(0.0, 0.2), ylabel="slip, front left")
    right.plot(time, rates, color=ON)
    right.axhline(SPEED, color=FORBIDDEN, lw=1.2)
    right.set_ylabel("wheel speed (rad/s)")
    for ax in (left, right):
        ax.set_xlabel("time (s)")
    return figure
