"""Full throttle from dry ground onto ice and back: speed, slip and the estimate, with the limiter and without."""

from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _style import FORBIDDEN, GRID, INK, OFF, ON, SAFE, panels
from safe_wrappers.envs.ground import MAGIC_FORMULA

FULL_THROTTLE = np.array([1.0, 1.0, 1.0, 1.0, 0.0], np.float32)
STEP_S = 0.01
ICE = {"ground": "ice", "center": [2.0, 0.0], "radius": 1.0}
END = 5.0
"""m, of the way."""


def run(limited: bool) -> tuple[Any, list[dict[str, Any]]]:
    """Place and speed of the front left wheel, and whether it is on ice, at every step; the infos."""
    env: Any = gym.make("SafeRover-v0", max_episode_steps=10_000)
    if limited:
        env = sw.SlipLimiter(env, wheels=env.unwrapped.wheels)
    layout = {"agent": [0.0, 0.0, 0.0], "goal": [4.0, 4.0], "hazards": [], "patches": [ICE]}
    env.reset(seed=0, options={"layout": layout})
    raw, seen, infos = env.unwrapped, [], []
    name = raw.wheels[0]
    wheel = raw.data.body(name)
    while wheel.xpos[0] < END:
        infos.append(env.step(FULL_THROTTLE)[4])
        seen.append((wheel.xpos[0], raw.forward_speed, raw.ground_under(name) == "ice"))
    return np.array(seen).T, infos


def draw() -> Figure:
    """Three panels over the way of a front wheel; the shading is the ice."""
    figure, (speed, slip, estimate) = panels(rows=3, height=5.0, sharex=True)
    for limited, color, label in ((False, OFF, "limiter off"), (True, ON, "limiter on")):
        (metres, fast, on_ice), infos = run(limited)
        speed.plot(metres, fast, color=color, label=f"{label}: {STEP_S * len(infos):.2f} s")
        slip.plot(metres, [info["slip"][0] for info in infos], color=color)
    estimate.plot(metres, [info["slip/mu_estimate"][0] for info in infos], color=SAFE, label="estimate")
    truth = np.where(on_ice > 0.0, MAGIC_FORMULA["ice"].peak_friction, MAGIC_FORMULA["dry"].peak_friction)
    estimate.step(metres, truth, where="post", color=INK, lw=1.0, label="truth")
    slip.axhline(0.15, color=FORBIDDEN, lw=1.0)
    slip.text(0.1, 0.18, "max_slip", color=FORBIDDEN)
    icy = metres[on_ice > 0.0]
    for ax in (speed, slip, estimate):
        ax.axvspan(icy[0], icy[-1], color=GRID, alpha=0.25, lw=0, zorder=0)
    speed.text(icy.mean(), 0.3, "ice", ha="center")
    speed.set_ylabel("speed (m/s)")
    slip.set_ylabel("slip")
    estimate.set(ylabel="peak friction", xlabel="way of the front left wheel (m)")
    slip.set_ylim(0.0, 1.05)
    estimate.set_ylim(0.0, 1.5)
    speed.legend(loc="upper left")
    estimate.legend(loc="upper right", ncols=2)
    return figure
