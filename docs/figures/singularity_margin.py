"""A Cartesian policy moves Reacher's fingertip along a circle that ends 1.5 mm beyond the stretched arm."""

import gymnasium as gym
import mujoco
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle

import safe_wrappers as sw
from _drivers import sides
from _style import FORBIDDEN, GRID, INK, bare, panels

MIDDLE, RADIUS, SPEED = np.array([0.1715, 0.0]), 0.04, 0.1
START = (np.array([-0.9549, 1.7911, 0.1, -0.1]), np.zeros(4))


def reference(t: float) -> np.ndarray:
    """The place wanted at a time, m."""
    phase = np.pi + SPEED * t / RADIUS
    return np.asarray(MIDDLE + RADIUS * np.array([np.cos(phase), np.sin(phase)]))


def follow(env: gym.Env) -> tuple[np.ndarray, np.ndarray]:
    """Resolved rates and a velocity loop around the circle: the fingertip's way, and the largest joint rates."""
    raw = env.unwrapped
    model, data, jacobian = raw.model, raw.data, np.zeros((3, raw.model.nv))
    tip = model.body("fingertip").id
    env.reset(seed=0)
    raw.set_state(*START)
    places, rates = [], []
    for k in range(int(2.0 * np.pi * RADIUS / SPEED / 0.02)):
        now, ahead = reference(0.02 * k), reference(0.02 * (k + 1))
        mujoco.mj_forward(model, data)
        mujoco.mj_jacBody(model, data, jacobian, None, tip)
        velocity = (ahead - now) / 0.02 + 10.0 * (now - data.xpos[tip, :2])
        wanted = np.linalg.pinv(jacobian[:2, :2]) @ velocity
        torque = (25.0 * (wanted - data.qvel[:2]) + wanted) / 200.0
        env.step(np.clip(torque, -1.0, 1.0).astype(np.float32))
        mujoco.mj_kinematics(model, data)
        places.append(data.xpos[tip, :2].copy())
        rates.append(np.abs(data.qvel[:2]).max())
    return np.array(places), np.array(rates)


def draw() -> Figure:
    """Left the ways, right the joint rates."""
    figure, (ways, speeds) = panels(2, height=3.0, width_ratios=[0.9, 1.3])
    margin = sw.constraints.SingularityMargin(
        body="fingertip", directions="xy", task_speed=0.1, rate_limit=5.0, horizon=8
    )
    time = np.linspace(0.0, 2.0 * np.pi * RADIUS / SPEED, 200)
    ways.plot(*np.array([reference(t) for t in time]).T, color=GRID, lw=0.9, ls="--")
    ways.add_patch(Circle((0.0, 0.0), 0.21, fill=False, ec=FORBIDDEN, lw=1.2))
    for env, color, name in sides("Reacher-v5", margin):
        places, rates = follow(env)
        ways.plot(*places.T, color=color, lw=1.2)
        speeds.plot(0.02 * np.arange(len(rates)), rates, color=color, lw=1.3, label=name)
    ways.plot(*reference(0.0), "s", color=INK, ms=4)
    ways.text(0.196, 0.062, "reach", color=FORBIDDEN, ha="right", va="bottom")
    bare(ways)
    ways.set(xlim=(0.11, 0.225), ylim=(-0.075, 0.075))
    speeds.set(xlabel="time (s)", ylabel="largest joint rate (rad/s)", ylim=(0.0, None))
    speeds.legend(loc="upper left")
    return figure
