"""A ball over a floor between two posts, and envs that do to its physics what real ones do."""

import gymnasium as gym
import mujoco
import numpy as np

XML = """<mujoco>
<option timestep="{timestep}" integrator="{integrator}" cone="{cone}"/>
<worldbody>
  <geom name="floor" type="plane" size="5 5 .1" solref="-{stiffness} -{damping}" solimp="{impedance}"/>
  <body name="ball" pos="0 0 {height}"><freejoint/>
    <geom name="ball" size=".1" mass="{mass}" solref="-{stiffness} -{damping}" solimp="{impedance}"/></body>
  <body name="box" pos="1 0 .2"><freejoint/><geom type="box" size=".2 .2 .2" mass="3"/></body>
  <body name="cart" pos="2 0 1"><joint name="slide" type="slide" axis="1 0 0"/><geom size=".05"/></body>
  <body name="hand" mocap="true" pos="3 0 1"><geom type="box" size=".1 .1 .1"/></body>
  <body name="puck" pos="3 0 1.4"><joint type="slide" axis="0 0 1"/><geom size=".1" mass=".5"/></body>
</worldbody>
<actuator>
  <motor joint="slide" gear="3"/>
  <general joint="slide" dyntype="integrator" actlimited="true" actrange="-.3 .3" gainprm="5"/>
  <general joint="slide" dyntype="filter" dynprm=".05" gainprm="2"/>
</actuator></mujoco>"""


class DroppedBall(gym.Env):
    """Five substeps a step; the action is the control. `meddle` is what the env does beside that."""

    frame_skip = 5

    def __init__(self, meddle="nothing", integrator="Euler", cone="pyramidal", **world):
        values = {
            "timestep": 0.002,
            "stiffness": 5e3,
            "damping": 0.0,
            "mass": 2.0,
            "height": 0.5,
            "impedance": ".9 .95 .001",
            **world,
        }
        self.model = mujoco.MjModel.from_xml_string(XML.format(integrator=integrator, cone=cone, **values))
        self.data = mujoco.MjData(self.model)
        self.meddle = meddle
        self.action_space = gym.spaces.Box(-1.0, 1.0, (self.model.nu,), np.float64)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (self.model.nq + self.model.nv,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.steps = 0
        mujoco.mj_forward(self.model, self.data)
        return self.observe(), {}

    def observe(self):
        return np.concatenate([self.data.qpos, self.data.qvel])

    def step(self, action):
        model, data = self.model, self.data
        data.ctrl[:] = action
        self.steps += 1
        if self.meddle == "pushes":
            data.xfrc_applied[1] = [4.0 * np.sin(self.steps), 0, -3, 0, 0.1, 0]
        elif self.meddle == "moves the hand":
            data.mocap_pos[0, 2] = 1.0 + 0.1 * np.sin(0.2 * self.steps)
        elif self.meddle == "another model":
            one_more = '<body pos="4 0 1"><freejoint/><geom size=".1"/></body></worldbody>'
            self.model = model = mujoco.MjModel.from_xml_string(
                XML.replace("</worldbody>", one_more).format(**WORLD)
            )
            self.data = data = mujoco.MjData(model)
        for k in range(self.frame_skip):
            if self.meddle == "pushes in substeps":
                data.xfrc_applied[1, 2] = -2.0 * k
            mujoco.mj_step(model, data)
        if self.meddle == "nudges":
            data.qvel[6] += self.nudge
        elif self.meddle == "breaks":
            data.qvel[6] += 1.0
            data.contact.dist[:] = np.nan
        return self.observe(), 0.0, False, False, {}


WORLD = {
    "timestep": 0.001,
    "stiffness": 5e3,
    "damping": 0.0,
    "mass": 2.0,
    "height": 0.099,
    "impedance": ".9 .95 .001",
    "integrator": "implicit",
    "cone": "elliptic",
}
