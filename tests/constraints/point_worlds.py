"""Points among walls in MuJoCo, written out by hand: held for several physics steps, with or without a clip."""

import gymnasium as gym
import mujoco
import numpy as np

RADIUS = 0.1
BLOCKS = [
    (-3, 0, 1, 4),
    (3, 0, 1, 4),
    (0, -3, 4, 1),
    (0, 3, 4, 1),
    (0.6, 0.5, 0.4, 0.5),
    (-0.9, -0.6, 0.3, 0.2),
]
"""x, y, half size along x, half size along y."""


class PointWorld(gym.Env):
    """A ball on two slides in a room with two blocks.

    Args:
        frame_skip: Physics steps per control step.
        clip: Speed per axis to which it clips at the start of every control step; None does not.
        blocks: The walls.
        damping: Of both slides.
    """

    def __init__(self, frame_skip=1, clip=None, blocks=None, damping=1.0):
        boxes = "".join(
            f'<geom name="block{i}" type="box" pos="{x} {y} 0.2" size="{a} {b} 0.2"/>'
            for i, (x, y, a, b) in enumerate(BLOCKS if blocks is None else blocks)
        )
        self.model = mujoco.MjModel.from_xml_string(f"""
        <mujoco>
          <option timestep="0.01" gravity="0 0 0"/>
          <default><joint damping="{damping}"/><geom margin="0.002" density="1000" condim="1"/></default>
          <worldbody>
            {boxes}
            <body name="ball">
              <joint name="y" type="slide" axis="0 1 0"/><joint name="x" type="slide" axis="1 0 0"/>
              <geom name="ball" size="{RADIUS}"/>
            </body>
          </worldbody>
          <actuator>
            <motor joint="x" ctrlrange="-1 1" gear="100"/><motor joint="y" ctrlrange="-0.8 1" gear="90"/>
          </actuator>
        </mujoco>""")
        self.data = mujoco.MjData(self.model)
        self.frame_skip, self.clip = frame_skip, clip
        limits = self.model.actuator_ctrlrange.astype(np.float32)
        self.action_space = gym.spaces.Box(limits[:, 0], limits[:, 1], dtype=np.float32)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float64)
        self.walls = [self.model.geom(f"block{i}").id for i in range(self.model.ngeom - 1)]
        self.ball = self.model.geom("ball").id
        self._scratch = mujoco.MjData(self.model)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.place((0.0, -0.3), (0.0, 0.0), **(options or {}))
        return self._observation(), {}

    def place(self, at, velocity):
        """Put the ball somewhere: x, y and velocity along x, y (its slides are y first)."""
        self.data.qpos[:], self.data.qvel[:] = at[::-1], velocity[::-1]

    def step(self, action):
        if self.clip is not None:
            self.data.qvel[:] = np.clip(self.data.qvel, -self.clip, self.clip)
        self.data.ctrl[:] = action
        self.nearest, self.touched = np.inf, False
        for _ in range(self.frame_skip):
            mujoco.mj_step(self.model, self.data)
            self.nearest = min(self.nearest, self.gap())
            self.touched |= self.touches()
        return self._observation(), 0.0, False, False, {"touched": self.touched, "nearest": self.nearest}

    def gap(self):
        """Distance of the ball's surface from the nearest wall, m, from positions alone."""
        if not self.walls:
            return np.inf
        offset = np.abs(self.data.qpos[::-1] - self.model.geom_pos[self.walls, :2])
        beyond = offset - self.model.geom_size[self.walls, :2]
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
        return float((outside + np.minimum(beyond.max(axis=1), 0.0)).min()) - RADIUS

    def touches(self):
        """Whether MuJoCo reports a contact at the present position; `data.contact` is one step old."""
        self._scratch.qpos[:] = self.data.qpos
        mujoco.mj_fwdPosition(self.model, self._scratch)
        return self._scratch.ncon > 0

    def _observation(self):
        return np.concatenate([self.data.qpos, self.data.qvel])
