"""What hold and delay leave of a phase margin decides whether a real loop on a MuJoCo cart is stable."""

from collections import deque

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.appendix.watchdog.sampling import phase_margin_left
from safe_wrappers.errors import ConfigurationError

CART = """
<mujoco><option timestep="0.001" gravity="0 0 0"/>
  <worldbody><body><joint name="slide" type="slide" axis="1 0 0"/><geom size="0.1" mass="2"/></body></worldbody>
  <actuator><motor joint="slide" ctrlrange="-1000 1000"/></actuator>
</mujoco>
"""


class Cart(gym.Env):
    """A mass of 2 kg on a frictionless rail, pushed by a motor; one step is ten physics steps."""

    frame_skip = 10
    dt = 0.01

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(CART)
        self.data = mujoco.MjData(self.model)
        self.action_space = gym.spaces.Box(-1000.0, 1000.0, (1,), np.float64)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def _observe(self):
        return np.concatenate([self.data.qpos, self.data.qvel])

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[0] = 1.0
        return self._observe(), {}

    def step(self, action):
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, self.frame_skip)
        return self._observe(), 0.0, False, False, {}


def mujoco_plant(delay_s):
    return sw.MujocoPlant(delay_s=delay_s)


def analytic_plant(delay_s):
    return sw.AnalyticPlant(
        f=lambda x: np.array([x[1], 0.0]),
        g=lambda x: np.array([[0.0], [0.5]]),
        state=lambda env: np.concatenate([env.data.qpos, env.data.qvel]),
        hold_s=0.01,
        delay_s=delay_s,
    )


def swing(margin, crossover, late_by):
    """Amplitude of a PD loop on the cart after 30 s, commands `late_by` holds late; it starts with 1."""
    env = Cart()
    (position, speed), _ = env.reset(seed=0)
    # (kd s + kp) / (m s^2) with this crossover and this margin
    kp, kd = 2 * crossover**2 * np.cos(margin), 2 * crossover * np.sin(margin)
    queue = deque([0.0] * late_by)
    recent = deque(maxlen=300)
    for _ in range(3000):
        queue.append(-kp * position - kd * speed)
        (position, speed), *_ = env.step(np.clip([queue.popleft()], -1000, 1000))
        recent.append(abs(position))
    return max(recent)


@pytest.mark.parametrize("make", [mujoco_plant, analytic_plant])
@pytest.mark.parametrize(("margin", "crossover"), [(np.radians(45), 5.0), (np.radians(60), 8.0)])
def test_the_cart_s_loop_is_stable_where_something_is_left_and_only_there(make, margin, crossover):
    env = Cart()
    holds = margin / crossover / 0.01 - 0.5  # the delay, in holds, that uses the margin up
    for late_by, stable in ((int(holds) - 1, True), (int(holds) + 2, False)):
        plant = make(late_by * 0.01)
        plant.bind(env)
        left = phase_margin_left(plant, margin, crossover)
        assert left == pytest.approx(margin - crossover * (late_by * 0.01 + 0.005), rel=1e-12)
        assert (left > 0) == stable
        amplitude = swing(margin, crossover, late_by)
        assert amplitude < 0.5 if stable else amplitude > 2.0


def test_a_longer_hold_leaves_less():
    spring = {"f": lambda x: x, "g": lambda x: np.eye(1), "state": lambda env: np.zeros(1)}
    fast, slow = (sw.AnalyticPlant(**spring, hold_s=hold) for hold in (0.01, 0.05))
    assert phase_margin_left(fast, 1.0, 5.0) - phase_margin_left(slow, 1.0, 5.0) == pytest.approx(0.1)


def test_a_plant_that_is_not_bound_yet_says_so():
    with pytest.raises(ConfigurationError, match=r"plant\.bind\(env\)"):
        phase_margin_left(sw.MujocoPlant(), 1.0, 5.0)


def test_a_loop_faster_than_the_env_is_refused():
    with pytest.raises(ConfigurationError, match="Nyquist"):
        plant = mujoco_plant(0.0)
        plant.bind(Cart())
        phase_margin_left(plant, 1.0, 400.0)
