"""A world for what is seen and not: a turning robot, things that drive straight on, and a wall between."""

import gymnasium as gym
import mujoco
import numpy as np

import safe_wrappers as sw

TEXT = """
<mujoco>
  <option timestep="0.01" gravity="0 0 0"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    {world}
    <body name="robot" pos="0 0 0.5">
      <joint name="turn" type="hinge" axis="0 0 1"/>
      <geom size="0.05" mass="1"/>
      <site name="eye" pos="{arm}" euler="30 40 50"/>
      <camera name="front" pos="{arm}" xyaxes="0 -1 0 0 0 1" fovy="90"/>
    </body>
    <body name="thing" pos="0 0 0.5">
      <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/><geom size="0.1" mass="1"/>
    </body>
    <body name="thing2" pos="0 0 0.5">
      <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/><geom size="0.1" mass="1"/>
    </body>
    <body><geom size="0.01" pos="0 0 5"/></body>
  </worldbody>
  <actuator><motor joint="turn" ctrlrange="-1 1"/></actuator>
</mujoco>"""
WALL = '<geom type="box" pos="2 0 0.5" size="0.1 3 1"/>'


class Turning(gym.Env):
    """`start` is qpos and qvel at every reset: heading, thing's x and y, thing2's x and y."""

    frame_skip = 4

    def __init__(self, start=((0, 1, 0, -1, 0), (0, 0, 0, 0, 0)), world="", arm="0.4 0 0", space=None):
        self.start, self.arguments = start, (world, arm)
        self.build(world, arm)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)
        self.observation_space = space or gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)

    def build(self, world, arm):
        self.model = mujoco.MjModel.from_xml_string(TEXT.format(world=world, arm=arm))
        self.data = mujoco.MjData(self.model)

    @property
    def dt(self):
        return self.frame_skip * self.model.opt.timestep

    @property
    def spots(self):
        """Two points of the plane, on the other side of the wall and on this one."""
        return np.array([[4.0, 0.0], [0.0, 1.0]])

    def observed(self):
        low = self.observation_space
        if isinstance(low, gym.spaces.Dict):
            return {key: np.zeros(space.shape, space.dtype) for key, space in low.spaces.items()}
        return np.zeros(low.shape, low.dtype)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = self.start
        mujoco.mj_forward(self.model, self.data)
        return self.observed(), {}

    def step(self, action):
        self.data.ctrl[:] = action
        for _ in range(self.frame_skip):
            mujoco.mj_step(self.model, self.data)
        return self.observed(), 1.0, False, False, {}


STILL = np.zeros(1)


def straight(bodies="thing", **options):
    """A track of what drives straight on, without noise in its motion."""
    return sw.occlusion.Track(
        bodies, **{"acceleration_noise": 0.0, "start_position_std": 0.3, "start_velocity_std": 0.3} | options
    )
