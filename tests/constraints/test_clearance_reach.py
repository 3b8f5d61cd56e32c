"""What no control can reach is left out of `Clearance` early: it is what has no rows in the whole look."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import bound

import safe_wrappers as sw

SERVO = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body pos="0 0 0.3"><joint name="slide" type="slide" axis="1 0 0" range="-1 1" limited="true"/>
      <geom size="0.1" mass="2"/>
      <body name="tip" pos="0.4 0 0"><joint name="swing" axis="0 1 0" pos="-0.4 0 0" damping="0.1"/>
        <geom type="capsule" fromto="-0.4 0 0 0 0 0" size="0.04" mass="1"/></body>
    </body>
  </worldbody>
  <actuator>
    <position joint="slide" kp="60" kv="3" ctrlrange="0.1 1" forcerange="-40 40"/>
    <general joint="swing" gaintype="affine" gainprm="5 1 0.5" ctrlrange="-1 1"/>
  </actuator>
</mujoco>"""


class Machine(gym.Env):
    """A servo on a slide and a swinging arm that meets the ground."""

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(SERVO)
        self.data = mujoco.MjData(self.model)
        self.frame_skip = 5
        low, high = self.model.actuator_ctrlrange.T.astype(np.float32)
        self.action_space = gym.spaces.Box(low, high)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (4,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        return np.zeros(4), {}


WALLS = [
    sw.constraints.Plane([-1.2], [1.0]),
    sw.constraints.Sphere([0.0, 0.0, 1.6], 0.3),
    sw.constraints.Box([1.6, 0.0, 0.5], [0.2, 0.2, 0.2]),
    sw.constraints.Disc([0.0, 1.5], 0.4),
]
CASES = {
    "servo": (Machine, ["tip"], 2.0),
    "pendulum": (lambda: gym.make("InvertedPendulum-v5"), ["cart", "pole"], 8.0),
    "hopper": (lambda: gym.make("Hopper-v5"), ["torso"], 4.0),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_out_of_reach_has_no_rows(case):
    make, bodies, braking = CASES[case]
    env = make()
    env.reset(seed=0)
    plant = bound(env)
    clearance = sw.constraints.Clearance(WALLS, braking, bodies=bodies, margin=0.01).bind(plant)
    raw, rng, far, touched, reached = env.unwrapped, np.random.default_rng(1), 0, 0, 0
    start = raw.data.qpos.copy()
    always = plant.lower, plant.upper, plant.delay_s, plant.control_dt, 0.0, braking, 0.01
    for _ in range(400):
        raw.data.qpos[:] = start + rng.uniform(-1.3, 1.3, start.size)
        raw.data.qvel[:] = rng.normal(size=raw.model.nv) * rng.choice([0.1, 1.0])
        plant.observe()
        rooms, rows = clearance._near(always)
        found = clearance._far(always)
        if found is None:
            reached += 1
            continue
        far += 1
        touched += plant.data.nefc > 0
        np.testing.assert_array_equal(found[0], rooms)
        assert not rows.offsets.size and found[1].normals.shape == (0, plant.lower.size)
    assert far > 20 and reached > 20 and touched > 5, (far, reached, touched)


@pytest.mark.parametrize("case", CASES)
def test_a_control_changes_the_acceleration_of_a_point_by_no_more_than_its_reach(case):
    make, bodies, _ = CASES[case]
    env = make()
    env.reset(seed=0)
    plant = bound(env)
    points = sw.constraints.Clearance(WALLS, 1.0, bodies=bodies).bind(plant)._points
    raw, rng, tight, saturated = env.unwrapped, np.random.default_rng(2), 0.0, 0
    start = raw.data.qpos.copy()
    idle = np.clip(0.0, plant.lower, plant.upper)
    for _ in range(200):
        raw.data.qpos[:] = start + rng.uniform(-1.3, 1.3, start.size)
        raw.data.qvel[:] = rng.normal(size=raw.model.nv)
        plant.observe()
        for reach, (p, v, drift, effect) in zip(points.reaches(), points.accelerations(), strict=True):
            np.testing.assert_array_equal(reach[:6], np.r_[p, v])
            size = np.abs(drift).max() + 1.0
            now = reach[6:9]
            motion = plant.data.actuator_length, plant.data.actuator_velocity
            least, most = plant.actuators.acting_range(*motion)
            acting = np.clip(idle, least, most)
            assert not effect[:, most <= least].any()  # saturated: no control changes the force
            saturated += int((most <= least).sum())
            np.testing.assert_allclose(now, drift + effect @ acting, atol=1e-9 * size)
            for normal in rng.normal(size=(5, 3)):
                n = normal / np.linalg.norm(normal)
                most = np.sqrt(n @ reach[9:18].reshape(3, 3) @ n * reach[18:])
                assert (np.abs(n @ effect) <= most * (1.0 + 1e-9) + 1e-12).all()
                tight = max(tight, float((np.abs(n @ effect) / most).max()))
    assert tight > 0.4
    assert (saturated > 10) == (case == "servo")
