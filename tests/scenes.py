"""An MJCF as an env, with nothing that a filter does not ask for."""

import gymnasium as gym
import mujoco
import numpy as np


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
