"""An MJCF as an env, with nothing that a filter does not ask for; and other packages' envs."""

import warnings

import gymnasium as gym
import mujoco
import numpy as np
import pytest


def make(env_id, **options):
    """`gym.make`, also of gymnasium-robotics' envs; whoever asks for one without it is skipped."""
    if any(word in env_id for word in ("Maze", "Fetch", "Hand")):
        gym.register_envs(pytest.importorskip("gymnasium_robotics"))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*is out of date")
        return gym.make(env_id, **options)


class Scene(gym.Env):
    """Any MJCF as an env; it resets to the model's own pose, or to `start`, (qpos, qvel)."""

    start = None

    def __init__(self, xml, frame_skip=5):
        self.xml = xml
        self.model = mujoco.MjModel.from_xml_string(xml)
        self.data = mujoco.MjData(self.model)
        self.frame_skip = frame_skip
        self.dt = frame_skip * self.model.opt.timestep
        limited = self.model.actuator_ctrllimited.astype(bool)
        low = np.where(limited, self.model.actuator_ctrlrange[:, 0], -np.inf)
        high = np.where(limited, self.model.actuator_ctrlrange[:, 1], np.inf)
        self.action_space = gym.spaces.Box(low, high, dtype=np.float64)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        if self.start is not None:
            self.data.qpos[:], self.data.qvel[:] = self.start
        mujoco.mj_forward(self.model, self.data)
        return np.zeros(1), {}

    def step(self, action):
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, nstep=self.frame_skip)
        return np.zeros(1), 0.0, False, False, {}


class Legs(Scene):
    """A trunk on two driven legs beside other things that move; the action is the control."""

    XML = """<mujoco><option timestep="0.002" integrator="{integrator}" cone="{cone}"/>
    <default><geom condim="{condim}" friction="0.6 0.01 0.002"/></default>
    <worldbody>
      <geom name="floor" type="plane" size="5 5 .1"/>
      <body name="step" pos=".35 0 0"><geom name="step" type="box" size=".1 .3 .06"/></body>
      <body name="lift" mocap="true" pos="-.35 0 0"><geom name="lift" type="box" size=".1 .3 .05"/></body>
      <body name="trunk" pos="0 0 .42"><freejoint/>
        <geom name="trunk" type="box" size=".3 .1 .05" mass="4"/>
        <body name="front" pos=".3 0 0"><joint name="hip" axis="0 1 0" range="-40 40" damping=".5"/>
          <geom name="front" type="capsule" fromto="0 0 0 0 0 -.3" size=".05" mass=".6"/></body>
        <body name="back" pos="-.3 0 0"><joint name="tail" axis="0 1 0" range="-40 40" damping=".5"/>
          <geom name="back" type="capsule" fromto="0 0 0 0 0 -.3" size=".05" mass=".6"/></body>
      </body>
      <body name="load" pos="0 0 .55"><freejoint/><geom name="load" type="box" size=".1 .1 .06" mass="1"/></body>
      {more}
    </worldbody>
    <actuator><motor name="hip" joint="hip" gear="40" ctrllimited="true" ctrlrange="-1 1"/>
      <motor name="tail" joint="tail" gear="40" ctrllimited="true" ctrlrange="-1 1"/>{act}</actuator>
    {end}</mujoco>"""

    def __init__(self, integrator="Euler", cone="pyramidal", condim=3, more="", act="", end=""):
        super().__init__(
            self.XML.format(integrator=integrator, cone=cone, condim=condim, more=more, act=act, end=end)
        )
