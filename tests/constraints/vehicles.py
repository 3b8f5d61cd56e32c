"""Small vehicles on wheels for tests: how they are built decides what a constraint may say of them."""

from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.spaces import Box

import safe_wrappers as sw

TROLLEY = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <geom name="floor" type="plane" size="50 50 0.1" friction="0.01 0.005 0.0001"/>
    <body name="trolley" pos="0 0 {height}">
      <freejoint name="trolley"/>
      <geom name="hull" type="box" size="0.25 0.15 0.03" pos="0 0 0.05" mass="4" contype="0" conaffinity="0"/>
      <body name="front" pos="0.2 0 0">{caster}</body>
      <body name="left" pos="-0.15 0.2 0">
        <joint name="left" axis="0 1 0" damping="{damping}" armature="0.01"/>{wheel}
      </body>
      <body name="right" pos="-0.15 -0.2 0">
        <joint name="right" axis="0 1 0" damping="{damping}" armature="0.01"/>{wheel}
      </body>
    </body>
  </worldbody>
  <actuator>{actuators}</actuator>
</mujoco>
"""
WHEEL = '<geom type="cylinder" size="0.1 0.02" euler="90 0 0" mass="0.5" friction="{friction} 0.005 0.0001"/>'
CASTER = '<geom type="sphere" size="0.1" mass="0.2" condim="1" priority="1"/>'
MOTORS = '<motor joint="left" gear="6" ctrlrange="-1 1"/><motor joint="right" gear="6" ctrlrange="-1 1"/>'
FULL = np.array([1.0, 1.0, 1.0, 1.0, 0.0], dtype=np.float32)
OPEN = {"agent": [0.0, 0.0, 0.0], "goal": [4.0, 4.0], "hazards": [], "patches": []}


def rover(**options):
    """SafeRover under a SlipLimiter of all its wheels."""
    env = gym.make("SafeRover-v0", max_episode_steps=100_000)
    return sw.CBFActionFilter(env, [sw.constraints.Traction(env.unwrapped.wheels, **options)])


class Trolley(gym.Env[Any, Any]):
    """Two driven wheels behind, a frictionless caster in front; MuJoCo's own friction carries it."""

    def __init__(self, friction=0.7, height=0.1, wheel=WHEEL, actuators=MOTORS, damping=0.01, substeps=5):
        text = TROLLEY.format(
            height=height,
            wheel=wheel.format(friction=friction),
            caster=CASTER,
            actuators=actuators,
            damping=damping,
        )
        self.model = mujoco.MjModel.from_xml_string(text)
        self.data = mujoco.MjData(self.model)
        self.frame_skip, self.dt = substeps, 0.002 * substeps
        span = self.model.actuator_ctrlrange.astype(np.float32)
        self.action_space = Box(span[:, 0], span[:, 1], dtype=np.float32)
        self.observation_space = Box(-np.inf, np.inf, (self.model.nq + self.model.nv,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)
        return self.observe(), {}

    def observe(self):
        return np.concatenate([self.data.qpos, self.data.qvel])

    def step(self, action):
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, self.frame_skip)
        return self.observe(), 0.0, False, False, {}
