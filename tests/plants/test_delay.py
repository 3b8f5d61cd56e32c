"""What a delay does: plants predict the state over it, and warn where it takes too much of a loop's margin."""

import warnings

import numpy as np
import pytest
from asking import pushed
from scenes import Scene

import safe_wrappers as sw
from safe_wrappers.errors import PhaseMarginWarning
from safe_wrappers.plants import ControlLoop

CART = """<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody><body>
<joint name="x" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/></body></worldbody>
<actuator><motor joint="x" ctrlrange="-1e3 1e3"/></actuator></mujoco>"""
STEP_S, HOLD_S = 0.01, 0.05


def simulated(delay_s):
    return sw.MujocoPlant(delay_s=delay_s)


def analytic(delay_s):
    return pushed(lambda env: [env.data.qpos[0], env.data.qvel[0]], delay_s=delay_s)


def observing(kind, delay_s, x=0.2, v=1.5, sent=()):
    """A plant on a cart of 1 kg, to which these commands have been sent."""
    env, plant = Scene(CART, frame_skip=5), kind(delay_s)
    plant.bind(env)
    env.data.qpos[0], env.data.qvel[0] = x, v
    plant.executed(np.array([9.0]))
    plant.executed(None)  # of the last episode nothing is left
    for u in sent:
        plant.executed(np.array([u]))
    plant.observe()
    return plant


def after(delay_s, sent, euler):
    """Where the cart is after the delay, if command k acts from k holds and the delay on; `len(sent)` holds in."""
    x, v = 0.2, 1.5
    for i in range(round(delay_s / STEP_S)):
        k = int(np.floor((len(sent) * HOLD_S + i * STEP_S - delay_s) / HOLD_S + 1e-9))
        a = sent[k] if k >= 0 else 0.0
        x += (v + a * STEP_S if euler else v + 0.5 * a * STEP_S) * STEP_S
        v += a * STEP_S
    return x, v


@pytest.mark.parametrize("kind", [simulated, analytic])
@pytest.mark.parametrize("delay_s", [0.05, 0.1, 0.03, 0.07, 0.12])
def test_the_state_is_predicted_with_the_commands_in_flight(kind, delay_s):
    for sent in ([0.3, -0.7, 1.0, 0.4], [0.3], []):  # in a young episode little is in flight
        plant = observing(kind, delay_s, sent=sent)
        np.testing.assert_allclose(
            plant.state, after(delay_s, sent, kind is simulated), atol=1e-12 if kind is simulated else 1e-9
        )


@pytest.mark.parametrize("kind", [simulated, analytic])
def test_a_state_that_is_no_number_is_not_predicted_to_be_one(kind):
    assert np.isnan(observing(kind, 0.07, v=np.nan).state).any()  # MuJoCo would step on from its own reset


# A declared loop --------------------------------------------------------------------------------------------------


def test_too_little_margin_is_said_once_with_its_numbers():
    env = Scene(CART, frame_skip=1)
    plant = sw.MujocoPlant(delay_s=0.1, loop=ControlLoop(4.0, 60.0, compute_s=0.05, bus_s=0.02))
    with pytest.warns(PhaseMarginWarning) as said:
        plant.bind(env)
    with warnings.catch_warnings(action="error"):
        plant.bind(env)
    (warning,) = said
    # 4 rad/s * (0.1 + 0.05 + 0.02 + 0.005) s = 0.7 rad = 40.1 degrees
    for number in ("19.9 degrees", "margin of 60", "less than 30", "a loop of 4 rad/s"):
        assert number in str(warning.message)
    # At the crossover that is advised exactly the wanted margin is left, to its printed digits.
    assert "at most 2.99 rad/s" in str(warning.message)
    assert ControlLoop(2.99, 60.0, 0.05, 0.02).margin_left_deg(0.01, 0.1) == pytest.approx(30.0, abs=0.05)
