"""What the tests of TeleopChannel share: the task behind a channel, drivers, and energy counted from outside."""

import gymnasium as gym
import numpy as np

import safe_wrappers as sw
from safe_wrappers.envs.teleop_contact import (
    CLAMP_Y,
    TELEOP_ACCELERATION,
    TELEOP_BRAKING,
    TELEOP_TOP_SPEED,
    TOOL_RADIUS,
)

MARGIN = 0.001


def clamp(braking=TELEOP_BRAKING, margin=MARGIN):
    """The clamp's face, as a constraint."""
    face = sw.constraints.Plane([0.0, CLAMP_Y], [0.0, -1.0])
    return sw.constraints.Clearance([face], braking, bodies=["tool"], radius=TOOL_RADIUS, margin=margin)


def ceiling(braking=TELEOP_BRAKING, margin=MARGIN, delays_s=0.0, **times):
    """What a channel with a ceiling takes."""
    machine = {"acceleration": TELEOP_ACCELERATION, "top_speed": TELEOP_TOP_SPEED, "delays_s": delays_s}
    return {"budget": sw.StoppingBudget(clamp(braking, margin), **machine), **times}


def channel(uplink=0.0, downlink=0.0, inside=None, **options):
    env = gym.make("TeleopContact-v0", max_episode_steps=100_000)
    return sw.TeleopChannel(env if inside is None else inside(env), uplink, downlink, **options)


def place(env, tool=(0.0, 0.0), velocity=(0.0, 0.0), seed=0):
    layout = {"tool": list(tool), "velocity": list(velocity), "wanted_force": 8.0}
    return env.reset(seed=seed, options={"layout": layout})


class Energies:
    """Net energy at the two ports, by what an operator is shown and what the env says that acted."""

    def __init__(self, env):
        self.env = env
        self.into = self.out = self.worst = self.through = 0.0

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        raw = self.env.unwrapped
        self.into += float(observation[4:6] @ np.clip(action, -1, 1)) * raw.dt
        if not (info["teleop/revoked"] or info.get("cbf/intervened", False)):
            out = float(raw.port_effort_acted @ info["executed_action"]) * raw.dt
            self.out += out
            self.through += abs(out)
        self.worst = max(self.worst, self.out + self.env.stored_j - self.into)
        return observation, reward, terminated, truncated, info
