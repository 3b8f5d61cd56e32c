"""The slip ratio, and the window of a slip limit."""

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.control.vehicle import Wheel, slip_ratio, slip_window
from safe_wrappers.errors import ConfigurationError

speeds = st.floats(-30.0, 30.0)
slips = st.floats(0.01, 0.9)
floors = st.floats(0.01, 2.0)


@pytest.mark.parametrize(
    ("wheel", "ground", "slip"),
    [
        (2.0, 2.0, 0.0),  # rolling
        (3.0, 0.0, 1.0),  # spins on the spot
        (0.0, 3.0, -1.0),  # locked
        (2.0, 1.0, 0.5),  # drives
        (1.0, 2.0, -0.5),  # brakes
        (-2.0, -1.0, -0.5),  # drives in reverse: pushes backwards
        (-1.0, -2.0, 0.5),  # brakes in reverse: pushes forwards
        (1.0, -1.0, 2.0),  # turns against the motion
        (0.0, 0.0, 0.0),  # at rest
    ],
)
def test_named_cases(wheel, ground, slip):
    assert slip_ratio(wheel, ground, 1e-3) == slip


@given(speeds, slips, floors)
def test_the_window_ends_where_the_slip_is_reached(ground, limit, floor):
    low, high = slip_window(ground, limit, floor)
    assert slip_ratio(low, ground, floor) == pytest.approx(-limit, abs=1e-9)
    assert slip_ratio(high, ground, floor) == pytest.approx(limit, abs=1e-9)


@given(speeds, speeds, slips, floors)
def test_the_window_is_the_limit(wheel, ground, limit, floor):
    low, high = slip_window(ground, limit, floor)
    slip = float(slip_ratio(wheel, ground, floor))
    if abs(abs(slip) - limit) > 1e-9:
        assert (low < wheel < high) == (abs(slip) < limit)


def test_a_bad_slip_is_refused():
    with pytest.raises(ConfigurationError, match="max_slip"):
        slip_window(1.0, "much", 0.5)


# A driven wheel over one control interval, against MuJoCo and scipy


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
