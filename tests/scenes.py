"""An MJCF as an env, with nothing that a MujocoPlant does not ask for."""

import gymnasium as gym
import mujoco
import numpy as np


class Scene(gym.Env):
    """Any MJCF as an env: the least that a MujocoPlant may ask for."""

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
