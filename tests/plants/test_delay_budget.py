"""What hold and delay leave of a phase margin: against python-control, and a real loop on a MuJoCo cart."""

import warnings
from collections import deque

import control as ct
import gymnasium as gym
import mujoco
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.errors import PhaseMarginWarning
from safe_wrappers.plants import ControlLoop

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


def mujoco_plant(loop=None, delay_s=0.0):
    return sw.MujocoPlant(delay_s=delay_s, loop=loop)


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


@pytest.mark.parametrize(("margin", "crossover"), [(np.radians(45), 5.0), (np.radians(60), 8.0)])
def test_the_cart_s_loop_is_stable_where_something_is_left_and_only_there(margin, crossover):
    env = Cart()
    holds = margin / crossover / 0.01 - 0.5  # the delay, in holds, that uses the margin up
    for late_by, stable in ((int(holds) - 1, True), (int(holds) + 2, False)):
        loop = ControlLoop(crossover, np.degrees(margin), warn_below_deg=0.0)
        plant = mujoco_plant(loop, late_by * 0.01)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore" if not stable else "error", PhaseMarginWarning)
            plant.bind(env)
        left = loop.margin_left_deg(plant.control_dt, plant.delay_s)
        assert left == pytest.approx(np.degrees(margin - crossover * (late_by * 0.01 + 0.005)), rel=1e-12)
        assert (left > 0) == stable
        amplitude = swing(margin, crossover, late_by)
        assert amplitude < 0.5 if stable else amplitude > 2.0


@pytest.mark.filterwarnings("ignore::RuntimeWarning:control", "ignore:stability_margins:UserWarning")
@pytest.mark.parametrize(("compute", "bus", "plant_delay"), [(0, 0, 0), (1, 0, 0), (0, 2, 0), (1, 1, 4)])
def test_what_is_left_is_the_margin_that_python_control_finds(compute, bus, plant_delay):
    """Delays in holds. The plant's own f and g, held, sampled and delayed, under a PD controller."""
    margin, crossover, hold = np.radians(70), 3.0, 0.01
    kp, kd = 2 * crossover**2 * np.cos(margin), 2 * crossover * np.sin(margin)
    declared = ControlLoop(crossover, 70.0, compute * hold, bus * hold, warn_below_deg=0.0)
    env = Cart()
    env.reset(seed=0)
    plant = mujoco_plant(declared, plant_delay * hold)
    plant.bind(env)
    plant.observe()
    machine = ct.ss([[0, 1], [0, 0]], plant.g, [[kp, kd]], [[0]])
    assert np.degrees(np.radians(ct.margin(machine)[1])) == pytest.approx(70.0, abs=1e-6)  # as designed
    late_by = ct.tf([1], [1, *[0] * (compute + bus + plant_delay)], hold)
    _, found, _, at = ct.margin(ct.tf(ct.sample_system(machine, hold, "zoh")) * late_by)
    assert at == pytest.approx(crossover, rel=1e-3)
    left = declared.margin_left_deg(plant.control_dt, plant.delay_s)
    assert left == pytest.approx(found, abs=0.1)
    assert 70.0 - found > 0.8


def test_too_little_margin_is_said_once_with_its_numbers():
    plant, env = mujoco_plant(ControlLoop(4.0, 60.0, compute_s=0.05, bus_s=0.02), 0.1), Cart()
    with pytest.warns(PhaseMarginWarning) as said:
        plant.bind(env)
        plant.bind(env)
    assert len(said) == 1
    text = str(said[0].message)
    # 4 rad/s * (0.1 + 0.05 + 0.02 + 0.005) s = 0.7 rad = 40.1 degrees
    for number in ("19.9 degrees", "margin of 60", "less than 30", "a loop of 4 rad/s"):
        assert number in text
    # at the crossover that is advised exactly the wanted margin is left, to its printed digits
    assert "at most 2.99 rad/s" in text
    assert ControlLoop(2.99, 60.0, 0.05, 0.02).margin_left_deg(0.01, 0.1) == pytest.approx(30.0, abs=0.05)
