"""Driven wheels: slip and its window, a held torque in MuJoCo, and estimates of traction curves of several shapes."""

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_wrappers.control.vehicle import PEAK_SLIPS, FrictionEstimate, Wheel, slip_ratio, slip_window
from safe_wrappers.envs.ground import MagicFormula

SPEEDS = st.floats(-30.0, 30.0)


def test_slips_that_have_a_name():
    rolls, at_rest = (2.0, 2.0, 0.0), (0.0, 0.0, 0.0)
    spins_on_the_spot, locked = (3.0, 0.0, 1.0), (0.0, 3.0, -1.0)
    drives, brakes, against = (2.0, 1.0, 0.5), (1.0, 2.0, -0.5), (1.0, -1.0, 2.0)
    in_reverse = (-2.0, -1.0, -0.5), (-1.0, -2.0, 0.5)  # driving pushes backwards, braking forwards
    cases = rolls, spins_on_the_spot, locked, at_rest, drives, brakes, against, *in_reverse
    wheel, ground, slip = np.transpose(cases)
    np.testing.assert_array_equal(slip_ratio(wheel, ground, 1e-3), slip)


@given(SPEEDS, SPEEDS, st.floats(0.01, 0.9), st.floats(0.01, 2.0))
def test_the_window_is_where_the_slip_is_within_its_limit(wheel, ground, limit, floor):
    low, high = slip_window(ground, limit, floor)
    assert slip_ratio(low, ground, floor) == pytest.approx(-limit, abs=1e-9)
    assert slip_ratio(high, ground, floor) == pytest.approx(limit, abs=1e-9)
    slip = abs(float(slip_ratio(wheel, ground, floor)))
    assert (low < wheel < high) == (slip < limit) or abs(slip - limit) <= 1e-9


AXLE = """
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
    model = mujoco.MjModel.from_xml_string(AXLE.format(damping=damping))
    data = mujoco.MjData(model)
    inertia = np.zeros(1)
    mujoco.mj_forward(model, data)
    mujoco.mj_mulM(model, data, inertia, np.ones(1))
    data.qvel[0], data.ctrl[0] = 7.0, 3.0
    mujoco.mj_step(model, data, 5)
    response = Wheel(np.array([0.1]), inertia, np.array([damping])).response(0.002, 5)
    # No ground, so no force of it; what is left is the wheel alone.
    assert response.decay * 7.0 + response.gain * 3.0 == pytest.approx(data.qvel[0], rel=1e-9)


@given(st.floats(-50.0, 50.0), st.floats(-10.0, 10.0), st.floats(0.0, 5.0), st.integers(0, 2**31))
def test_the_observer_reads_the_force_back_and_the_mean_of_one_that_changes(rate, torque, damping, seed):
    """Without damping the rate integrates the force, whatever its course; with damping it has to be constant."""
    rng = np.random.default_rng(seed)
    radius, inertia = np.array([0.1, 0.2]), np.array([0.05, 0.01])
    wheel = Wheel(radius, inertia, np.array([damping, 0.0]))
    forces = np.array([np.full(7, rng.uniform(-200.0, 200.0)), rng.uniform(-200.0, 200.0, 7)])
    before = after = np.full(2, rate)
    for force in forces.T:
        after = (after + 0.002 / inertia * (torque - radius * force)) / (
            1.0 + 0.002 * wheel.damping / inertia
        )
    found = wheel.traction(wheel.response(0.002, 7), before, after, np.full(2, torque))
    np.testing.assert_allclose(found, forces.mean(axis=1), rtol=1e-7, atol=1e-6)


# The friction of the ground ---------------------------------------------------------------------------------------


def learn(estimate, friction, slips, seed=0, noise=0.02):
    rng, n = np.random.default_rng(seed), estimate.mean.size
    for slip in slips:
        measured = friction(slip) + noise * rng.normal(size=n)
        estimate.travel(np.full(n, 0.01))
        estimate.update(np.full(n, slip), np.abs(measured), np.full(n, noise))


@pytest.mark.parametrize(
    ("c1", "c2", "c3", "peak"),
    [
        (1.070509, 31.485949, 0.410509, 1.0),
        (0.742827, 38.090353, 0.292827, 0.7),
        (0.322646, 28.866173, 0.122646, 0.3),
    ],
)
def test_a_curve_of_another_shape(c1, c2, c3, peak):
    """Burckhardt's. What it says of it is off by more than its standard deviation, but of use."""
    burckhardt = lambda slip: -c1 * np.expm1(-c2 * slip) - c3 * slip  # noqa: E731
    estimate = FrictionEstimate(4)
    learn(estimate, burckhardt, np.linspace(0.02, 0.2, 120))
    np.testing.assert_allclose(estimate.mean, peak, rtol=0.2)
    # Friction is lost by standing beside the peak: at the slip that is found, less than a twentieth.
    assert (burckhardt(estimate.peak_slip[0]) > 0.95 * peak).all()


def test_the_height_is_the_truth_but_for_a_few_hundredths():
    """Over random curves of its shape and random slips up to their peaks."""
    rng, off = np.random.default_rng(1), []
    for seed in range(200):
        slip = rng.uniform(0.06, 0.2)
        curve = MagicFormula(rng.uniform(0.1, 1.1), slip)
        estimate = FrictionEstimate(1)
        learn(estimate, curve.at, rng.uniform(0.0, 1.2 * slip, 40), seed=seed)
        off.append(abs(estimate.mean[0] - curve.peak_friction))
    assert np.quantile(off, 0.9) < 0.03


@given(st.lists(st.tuples(st.floats(0.0, 2.0), st.floats(0.0, 1e3), st.floats(1e-3, 10.0)), max_size=40))
def test_always_finite(measurements):
    estimate = FrictionEstimate(1)
    for slip, friction, noise in measurements:
        estimate.travel(np.array([slip]))
        estimate.update(np.array([slip]), np.array([friction]), np.array([noise]))
    assert np.isfinite(estimate.mean).all()
    assert estimate.weights.sum() == pytest.approx(1.0)
    assert PEAK_SLIPS[0] - 1e-9 <= estimate.peak_slip[0][0] <= PEAK_SLIPS[-1] + 1e-9


def test_on_another_ground_the_hypotheses_start_afresh():
    """Forgotten is what no hypothesis explains."""
    slips = np.random.default_rng(2).uniform(0.01, 0.2, 330)
    grounds = MagicFormula(peak_friction=0.3, peak_slip=0.05), MagicFormula(peak_friction=0.9, peak_slip=0.15)
    for first, second in (grounds, grounds[::-1]):
        moved, fresh = FrictionEstimate(1), FrictionEstimate(1)
        learn(moved, first.at, slips[:300])
        for each in (moved, fresh):
            learn(each, second.at, slips[300:], seed=1)
        np.testing.assert_allclose(moved.mean, fresh.mean, atol=0.02)
        np.testing.assert_allclose(moved.peak_slip[0], fresh.peak_slip[0], atol=0.01)
