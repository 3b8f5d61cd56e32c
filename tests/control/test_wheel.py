"""A driven wheel over one control interval, against MuJoCo and scipy."""

import math

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from safe_wrappers.control.vehicle.wheel import Wheel
from safe_wrappers.errors import ConfigurationError

CART = """
<mujoco>
  <option timestep="0.002" gravity="0 0 0"/>
  <worldbody>
    <body><joint name="axle" type="hinge" axis="0 1 0" damping="{damping}" armature="0.03"/>
      <geom type="cylinder" size="0.1 0.03" euler="90 0 0" mass="1.5"/></body>
  </worldbody>
  <actuator><motor joint="axle"/></actuator>
</mujoco>
"""


@pytest.mark.parametrize("damping", [0.0, 0.02, 30.0])
def test_a_held_torque_against_mujoco(damping):
    model = mujoco.MjModel.from_xml_string(CART.format(damping=damping))
    data = mujoco.MjData(model)
    inertia = np.zeros(1)
    mujoco.mj_forward(model, data)
    mujoco.mj_mulM(model, data, inertia, np.ones(1))
    data.qvel[0], data.ctrl[0] = 7.0, 3.0
    mujoco.mj_step(model, data, 5)
    response = Wheel(np.array([0.1]), inertia, np.array([damping])).response(0.002, 5)
    # No ground, so no force of it; what is left is the wheel alone.
    assert response.decay * 7.0 + response.gain * 3.0 == pytest.approx(data.qvel[0], rel=1e-9)


def test_many_small_steps_are_the_differential_equation():
    wheel = Wheel(np.array([0.1]), np.array([0.05]), np.array([0.4]))
    response = wheel.response(1e-6, 20_000)
    exact = solve_ivp(lambda _, w: (3.0 - 0.1 * 20.0 - 0.4 * w) / 0.05, (0.0, 0.02), [5.0], rtol=1e-10).y[
        0, -1
    ]
    assert response.decay * 5.0 + response.gain * (3.0 - 0.1 * 20.0) == pytest.approx(exact, rel=1e-5)


@given(
    st.floats(-50.0, 50.0),
    st.floats(-10.0, 10.0),
    st.floats(-200.0, 200.0),
    st.floats(0.0, 5.0),
    st.integers(1, 20),
)
def test_the_observer_reads_the_force_back(rate, torque, force, damping, substeps):
    wheel = Wheel(np.array([0.1, 0.2]), np.array([0.05, 0.01]), np.array([damping, 0.0]))
    response = wheel.response(0.002, substeps)
    before, tau = np.full(2, rate), np.full(2, torque)
    after = response.decay * before + response.gain * (tau - wheel.radius * force)
    np.testing.assert_allclose(wheel.traction(response, before, after, tau), force, rtol=1e-7, atol=1e-6)


def test_the_observer_reads_the_mean_of_a_force_that_changes():
    """Without damping the rate integrates the force, whatever its course."""
    wheel = Wheel(np.array([0.1]), np.array([0.05]), np.array([0.0]))
    response = wheel.response(0.002, 5)
    forces, rate = np.array([10.0, 20.0, -5.0, 40.0, 0.0]), 3.0
    for force in forces:
        rate += 0.002 / 0.05 * (1.0 - 0.1 * force)
    found = wheel.traction(response, np.array([3.0]), np.array([rate]), np.array([1.0]))
    assert found[0] == pytest.approx(forces.mean())


@pytest.mark.parametrize(
    ("constants", "says"),
    [
        ((0.0, 0.05, 0.0), "radius must be finite and > 0 m"),
        ((0.1, 0.0, 0.0), "inertia"),
        ((0.1, 0.05, -1.0), "damping"),
        ((math.nan, 0.05, 0.0), "radius"),
    ],
)
def test_bad_constants_are_refused(constants, says):
    with pytest.raises(ConfigurationError, match=says):
        Wheel(*(np.array([c]) for c in constants))
